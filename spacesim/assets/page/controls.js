// The page: orbiting, zooming, dragging the Sun; by mouse, touch and keys.

const FIELD_OF_VIEW = 35; // degrees, over the shorter side of the window
const SUN_AWAY = 1.25; // of the model's radius: where the Sun's handle stands
const START = { azimuth: 20, elevation: 20, distance: 1, sunAzimuth: 45, sunElevation: 35 };
const FRAME = 1000 / 30, REST = 250; // milliseconds: of a frame, and until the view is at rest
const SHARES = [1, 0.75, 0.5, 0.375]; // of the full resolution, while it moves where frames take longer
const DEGREES_PER_PIXEL = 0.4, DEGREES_PER_KEY = 5, ZOOM_PER_KEY = 1.15;

const element = (id) => document.getElementById(id);
const clamp = (value, least, most) => Math.min(Math.max(value, least), most);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

class Controls {
  constructor(renderer, about) {
    Object.assign(this, { renderer, about, canvas: renderer.canvas, handle: element("sun"), pointers: new Map(), share: 0 });
    this.fit = about.radius / Math.sin((FIELD_OF_VIEW / 2) * (Math.PI / 180)); // distance from which all is seen
    this.state = { ...START };
    for (const id of about.sun ? ["suns", "sun", "sunhelp", "sunkeys"] : []) element(id).hidden = false;
    this.#listen();
    this.change({});
  }

  /** Move the view or the Sun, and draw. */
  change(moves) {
    const state = Object.assign(this.state, moves);
    state.elevation = clamp(state.elevation, -89.9, 89.9);
    state.distance = clamp(state.distance, 0.05, 20);
    state.sunElevation = clamp(state.sunElevation, -90, 90);
    state.sunAzimuth = ((state.sunAzimuth % 360) + 360) % 360;
    for (const [id, value] of [["azimuth", state.sunAzimuth], ["elevation", state.sunElevation]]) {
      const output = document.querySelector(`output[for=${id}]`), text = `${value.toFixed(0)}°`;
      if (output.value === text && element(id).valueAsNumber === value) continue;
      element(id).value = value;
      output.value = text;
    }
    this.waiting ??= requestAnimationFrame((now) => this.#drawMoving(now));
  }

  /** A picture in the resolution that the last frames had time for; once all is at rest, the full one. */
  #drawMoving(now) {
    const took = now - this.last;
    if (took < REST) this.share = clamp(this.share + (took > 1.2 * FRAME) - (took < 0.6 * FRAME), 0, SHARES.length - 1);
    Object.assign(this, { waiting: null, last: now });
    this.draw(SHARES[this.share]);
    clearTimeout(this.resting);
    if (this.share > 0) this.resting = setTimeout(() => this.draw(), REST);
  }

  draw(share = 1) {
    const { canvas } = this, ratio = share * Math.min(window.devicePixelRatio, 2);
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((side) => Math.max(1, Math.round(side * ratio)));
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    const camera = this.camera(width, height), sun = directionFromAngles(this.state.sunAzimuth, this.state.sunElevation);
    this.renderer.draw(camera, sun);
    if (this.about.sun) this.#placeHandle(camera, sun, ratio);
  }

  /** The camera of a picture, pixels: see `Renderer.draw`. */
  camera(width, height) {
    const { azimuth, elevation, distance } = this.state, away = directionFromAngles(azimuth, elevation);
    const eye = this.about.centre.map((value, i) => value + distance * this.fit * away[i]);
    const forward = away.map((value) => -value), length = Math.hypot(forward[0], forward[1]);
    const right = [forward[1] / length, -forward[0] / length, 0], down = cross(forward, right);
    const focal = (0.5 * Math.min(width, height)) / Math.tan((FIELD_OF_VIEW / 2) * (Math.PI / 180));
    return { axes: [...right, ...down, ...forward], eye, lens: [focal, focal, width / 2, height / 2] };
  }

  #placeHandle({ axes, eye, lens }, sun, ratio) {
    const offset = this.about.centre.map((value, i) => value + SUN_AWAY * this.about.radius * sun[i] - eye[i]);
    const [x, y, z] = [0, 3, 6].map((row) => dot(axes.slice(row, row + 3), offset));
    const { clientWidth, clientHeight } = this.canvas, scale = lens[0] / Math.max(z, 1e-3) / ratio;
    const left = clamp(clientWidth / 2 + scale * x, 22, clientWidth - 22);
    const top = clamp(clientHeight / 2 + scale * y, 22, clientHeight - 22);
    this.handle.style.transform = `translate(${left}px, ${top}px)`; // which lays nothing out anew
    this.isNear = dot(axes.slice(6), sun) < 0;
    this.handle.classList.toggle("behind", !this.isNear);
  }

  #moveSun(right, up, degrees) {
    const { sunAzimuth, sunElevation } = this.state;
    this.change({ sunAzimuth: sunAzimuth + degrees * right, sunElevation: sunElevation + degrees * up });
  }

  #orbit(right, up, degrees) {
    this.change({ azimuth: this.state.azimuth - degrees * right, elevation: this.state.elevation - degrees * up });
  }

  #listen() {
    const { canvas, handle, pointers, about } = this;
    for (const target of [canvas, handle]) {
      target.addEventListener("pointerdown", (event) => {
        target.setPointerCapture(event.pointerId);
        const movesSun = about.sun && (target === handle || event.shiftKey);
        pointers.set(event.pointerId, { x: event.clientX, y: event.clientY, movesSun, side: this.isNear ? 1 : -1 });
      });
      target.addEventListener("pointermove", (event) => this.#drag(event));
      for (const end of ["pointerup", "pointercancel"])
        target.addEventListener(end, (event) => pointers.delete(event.pointerId));
      target.addEventListener("keydown", (event) => this.#press(event, target === handle));
    }
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.change({ distance: this.state.distance * Math.exp(clamp(event.deltaY, -200, 200) * 0.0015) });
    }, { passive: false });
    element("azimuth").addEventListener("input", (event) => this.change({ sunAzimuth: event.target.valueAsNumber }));
    element("elevation").addEventListener("input", (event) => this.change({ sunElevation: event.target.valueAsNumber }));
    element("panel").addEventListener("reset", (event) => {
      event.preventDefault();
      this.change(START);
    });
    new ResizeObserver(() => this.change({})).observe(canvas);
    canvas.addEventListener("webglcontextlost", () => element("message").append("The graphics were lost: reload the page."));
  }

  #drag(event) {
    const { pointers } = this, pointer = pointers.get(event.pointerId);
    if (!pointer) return;
    const right = event.clientX - pointer.x, down = event.clientY - pointer.y, apart = this.#apart();
    Object.assign(pointer, { x: event.clientX, y: event.clientY });
    if (pointers.size === 2) this.change({ distance: (this.state.distance * apart) / Math.max(this.#apart(), 1) });
    else if (pointer.movesSun) this.#moveSun(pointer.side * right, -down, DEGREES_PER_PIXEL);
    else if (pointers.size === 1) this.#orbit(right, -down, DEGREES_PER_PIXEL);
  }

  /** Pixels between two fingers. */
  #apart() {
    const [a, b] = this.pointers.values();
    return b ? Math.hypot(a.x - b.x, a.y - b.y) : 1;
  }

  #press(event, isSun) {
    const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    const zooms = { "+": 1 / ZOOM_PER_KEY, "=": 1 / ZOOM_PER_KEY, "-": ZOOM_PER_KEY };
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    if (arrows[event.key]) {
      const [right, up] = arrows[event.key];
      if (this.about.sun && (isSun || event.shiftKey)) this.#moveSun(this.isNear ? right : -right, up, DEGREES_PER_KEY);
      else this.#orbit(-right, -up, DEGREES_PER_KEY);
    } else if (zooms[event.key]) this.change({ distance: this.state.distance * zooms[event.key] });
    else if (event.key.toLowerCase() === "r") this.change(START);
    else return;
    event.preventDefault();
  }
}

async function start() {
  const about = JSON.parse(element("about").textContent), message = element("message");
  try {
    const arrays = await unpack(element("data").textContent, about.arrays);
    window.controls = new Controls(new Renderer(element("view"), about, arrays), about);
    message.textContent = "";
  } catch (error) {
    message.textContent = error.message;
    throw error;
  }
}

start();
