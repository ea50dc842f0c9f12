// WebGL 2: textures of the model, and a picture of what a camera sees under a Sun.

class Renderer {
  /** Raises Error where the browser has no WebGL 2. */
  constructor(canvas, about, arrays) {
    const gl = canvas.getContext("webgl2", { antialias: false, depth: false });
    if (!gl) throw new Error("This page needs WebGL 2, which this browser or its settings do not give.");
    Object.assign(this, { gl, canvas, about, arrays });
    this.isFine = Boolean(gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float"));
    const { count, components, terms, curve } = about, defines = {
      COMPONENTS: components, TERMS: terms, NODES: `${about.nodes?.[2] ?? 1}.0`, SPREAD: about.antialiased ? 1 / 12 : 0.3,
      LINEAR: Boolean(curve), FILMIC: curve?.tone === "filmic",
    };
    for (const name of ["cosines", "bounce", "antialiased", "curve"]) if (about[name]) defines[name.toUpperCase()] = "";
    const header = ["#version 300 es", "precision highp float;", "precision highp int;"];
    for (const [name, value] of Object.entries(defines)) header.push(`#define ${name} ${value}`);
    const program = (vertex, fragment) => this.#program(vertex, `${header.join("\n")}\n${fragment}`);
    this.shade = program(FULL_VERTEX, SHADE_FRAGMENT);
    this.splat = program(`${header.join("\n")}\n${SPLAT_VERTEX}`, SPLAT_FRAGMENT);
    this.show = program(FULL_VERTEX, SHOW_FRAGMENT);

    this.rows = Math.ceil(count / WIDTH);
    const texture = (...format) => this.#texture(WIDTH, this.rows, ...format);
    this.textures = {
      means: texture(gl.RGB32F, gl.RGB, gl.FLOAT, this.#padded(arrays.means, 3)),
      turns: texture(gl.RGBA16F, gl.RGBA, gl.HALF_FLOAT, this.#padded(arrays.quaternions, 4)),
      shapes: texture(gl.RGBA16F, gl.RGBA, gl.HALF_FLOAT, this.#padded(arrays.shapes, 4)),
      front: texture(gl.RGBA32F, gl.RGBA, gl.FLOAT, null),
      back: texture(gl.RGBA32F, gl.RGBA, gl.FLOAT, null),
      shaded: this.#empty(WIDTH, this.rows),
      colors: this.#layers(arrays.colors, components),
    };
    if (about.cosines) this.textures.table = this.#table(arrays.color_table);
    const normals = arrays.normals ?? new Int8Array(3 * count);
    this.textures.normals = texture(gl.RGB8_SNORM, gl.RGB, gl.BYTE, this.#padded(normals, 3));
    this.light = { front: new Float32Array(4 * WIDTH * this.rows), back: new Float32Array(4 * WIDTH * this.rows) };
    this.shadeTarget = this.#target(this.textures.shaded);
    this.textures.order = texture(gl.R32UI, gl.RED_INTEGER, gl.UNSIGNED_INT, null);
    this.sorted = new Uint32Array(WIDTH * this.rows);
    this.depths = new Float32Array(count);
    this.#makeQuads(count);
    this.sun = null;
  }

  /** Draw the picture that a camera {axes: [9] camera from world, eye: [3], lens: [4]} sees under a Sun [3]. */
  draw(camera, sun) {
    const { gl, canvas, about } = this;
    if (this.width !== canvas.width || this.height !== canvas.height) this.#resize(canvas.width, canvas.height);
    this.#shade(camera, sun);
    this.#sort(camera);

    const [fx, fy, cx, cy] = camera.lens, { width, height } = this;
    const limit = (share) => [(share * width - cx) / fx, (share * height - cy) / fy];
    const limits = [...limit(-0.15), ...limit(1.15)];
    gl.bindFramebuffer(gl.FRAMEBUFFER, about.curve ? this.pictureTarget : null);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    this.#use(this.splat, ["means", "turns", "shapes", "shaded", "order"]);
    gl.uniformMatrix3fv(this.#at("axes"), true, camera.axes);
    gl.uniform3fv(this.#at("eye"), camera.eye);
    gl.uniform4fv(this.#at("lens"), camera.lens);
    gl.uniform4fv(this.#at("limits"), limits);
    gl.uniform2f(this.#at("size"), width, height);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE_MINUS_DST_ALPHA, gl.ONE); // what is nearer comes first
    gl.drawElements(gl.TRIANGLES, 6 * this.drawn, gl.UNSIGNED_INT, 0);
    gl.disable(gl.BLEND);
    if (!about.curve) return;

    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    this.#use(this.show, []);
    this.#bind("picture", this.picture, gl.TEXTURE_2D, 0);
    gl.uniform1f(this.#at("white"), about.curve.white);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /** Colours of all Gaussians, a texel each. */
  #shade(camera, sun) {
    const { gl, about, arrays } = this;
    if (this.sun === null || sun.some((value, i) => value !== this.sun[i])) {
      this.sun = [...sun];
      lightUp(about, arrays, sun, this.light.front, this.light.back);
      for (const side of about.bounce ? ["front", "back"] : ["front"]) {
        gl.bindTexture(gl.TEXTURE_2D, this.textures[side]);
        gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDTH, this.rows, gl.RGBA, gl.FLOAT, this.light[side]);
      }
      if (!about.cosines)
        this.basis = interpolateRow(arrays.color_table, about.color_side, about.terms * about.components, sun);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.shadeTarget);
    gl.viewport(0, 0, WIDTH, this.rows);
    this.#use(this.shade, ["means", "normals", "front", "back"]);
    this.#bind("colors", this.textures.colors, gl.TEXTURE_2D_ARRAY, 6);
    if (about.cosines) this.#bind("table", this.textures.table, gl.TEXTURE_3D, 7);
    else gl.uniform4fv(this.#at("table"), this.basis);
    gl.uniform3fv(this.#at("eye"), camera.eye);
    gl.uniform3fv(this.#at("sun"), sun);
    gl.uniform1f(this.#at("offset"), about.offset);
    gl.uniform1f(this.#at("past"), about.earth ? pastEarth(sun, about.earth) : 1);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /** Numbers of the Gaussians before the camera that can be seen, near ones first: sorted by counting. */
  #sort({ axes, eye }) {
    const { gl, depths, sorted } = this, { count } = this.about, { means } = this.arrays, [, , , , , , x, y, z] = axes;
    const outside = this.#isOutside(eye);
    const shift = x * eye[0] + y * eye[1] + z * eye[2];
    let least = Infinity, most = -Infinity;
    for (let i = 0; i < count; i++) {
      depths[i] = x * means[3 * i] + y * means[3 * i + 1] + z * means[3 * i + 2] - shift;
      if (outside && !this.#isSeen(i, eye)) depths[i] = -Infinity;
      const depth = depths[i]; // in single precision
      if (depth > 0 && depth < least) least = depth;
      if (depth > most) most = depth;
    }
    const bins = 1 << 16, scale = (bins - 1) / Math.max(most - least, 1e-9), starts = new Uint32Array(bins + 1);
    for (let i = 0; i < count; i++) if (depths[i] >= least) starts[Math.floor((depths[i] - least) * scale) + 1]++;
    for (let bin = 0; bin < bins; bin++) starts[bin + 1] += starts[bin];
    this.drawn = starts[bins];
    for (let i = 0; i < count; i++) if (depths[i] >= least) sorted[starts[Math.floor((depths[i] - least) * scale)]++] = i;
    gl.bindTexture(gl.TEXTURE_2D, this.textures.order);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDTH, this.rows, gl.RED_INTEGER, gl.UNSIGNED_INT, sorted);
  }

  /** Whether no Gaussian but outliers is farther from the centre than the eye: maps of what is seen hold then. */
  #isOutside(eye) {
    const { centre, seen } = this.about;
    return Math.hypot(...centre.map((value, i) => eye[i] - value)) > seen.radius;
  }

  /** Whether a Gaussian is seen from the eye: its map's nearest direction. */
  #isSeen(i, eye) {
    const { means, seen } = this.arrays, { side } = this.about.seen;
    const x = eye[0] - means[3 * i], y = eye[1] - means[3 * i + 1], z = eye[2] - means[3 * i + 2];
    const cell = nearestCell(x, y, z, side);
    return (seen[(i * side * side + cell) >> 3] >> (cell & 7)) & 1;
  }

  /** Two triangles a Gaussian: software draws instances one by one, many times as slowly. */
  #makeQuads(count) {
    const { gl } = this, corners = new Uint32Array(6 * count);
    for (let i = 0; i < count; i++) [0, 1, 2, 2, 1, 3].forEach((corner, j) => (corners[6 * i + j] = 4 * i + corner));
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
  }

  /** Linear light is blended in half floats: eight bits would show steps in the dark. */
  #resize(width, height) {
    const { gl } = this;
    Object.assign(this, { width, height });
    if (!this.about.curve) return;
    gl.deleteFramebuffer(this.pictureTarget ?? null);
    gl.deleteTexture(this.picture ?? null);
    this.picture = this.#empty(width, height);
    this.pictureTarget = this.#target(this.picture);
  }

  /** A texture to draw into, of half floats where these can be. */
  #empty(width, height) {
    const { gl } = this;
    if (this.isFine) return this.#texture(width, height, gl.RGBA16F, gl.RGBA, gl.HALF_FLOAT, null);
    return this.#texture(width, height, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, null);
  }

  #target(color) {
    const { gl } = this, target = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, color, 0);
    return target;
  }

  #program(vertex, fragment) {
    const { gl } = this, program = Object.assign(gl.createProgram(), { places: {} });
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    return program;
  }

  #use(program, names) {
    this.program = program;
    this.gl.useProgram(program);
    names.forEach((name, unit) => this.#bind(name, this.textures[name], this.gl.TEXTURE_2D, unit));
  }

  #bind(name, texture, kind, unit) {
    const { gl } = this;
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(kind, texture);
    gl.uniform1i(this.#at(name), unit);
  }

  #at(name) {
    const { gl, program } = this;
    return (program.places[name] ??= gl.getUniformLocation(program, name));
  }

  #texture(width, height, inside, format, type, values) {
    const { gl } = this, texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texImage2D(gl.TEXTURE_2D, 0, inside, width, height, 0, format, type, values);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
    return texture;
  }

  #layers(values, layers) {
    const { gl, rows } = this, texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D_ARRAY, texture);
    gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.RGB8_SNORM, WIDTH, rows, layers);
    const length = values.length / layers;
    for (let k = 0; k < layers; k++) {
      const layer = this.#padded(values.subarray(k * length, (k + 1) * length), 3);
      gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, 0, k, WIDTH, rows, 1, gl.RGB, gl.BYTE, layer);
    }
    return texture;
  }

  #table(values) {
    const { gl, about } = this, [width, height, depth] = about.nodes, texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_3D, texture);
    gl.texImage3D(gl.TEXTURE_3D, 0, gl.RGBA16F, width, height, (depth * about.components) / 4, 0, gl.RGBA, gl.HALF_FLOAT, values);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_3D, name, gl.LINEAR);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T, gl.TEXTURE_WRAP_R])
      gl.texParameteri(gl.TEXTURE_3D, name, gl.CLAMP_TO_EDGE);
    return texture;
  }

  /** Numbers of the Gaussians with zeros up to the end of the texture's last row. */
  #padded(values, each) {
    const full = new values.constructor(each * WIDTH * this.rows);
    full.set(values);
    return full;
  }
}
