// The model: its arrays, unpacked from the page, and what a Sun makes of them.

const TYPES = { uint8: Uint8Array, int8: Int8Array, float16: Uint16Array, float32: Float32Array };

/** {name: typed array} of base64 text: deflated arrays one after another, as `arrays` describes them. */
async function unpack(text, arrays) {
  const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const bytes = await new Response(stream).arrayBuffer();
  const unpacked = {};
  for (const { name, type, start, length } of arrays) unpacked[name] = new TYPES[type](bytes, start, length);
  return unpacked;
}

/** Unit vector towards the Sun at an azimuth from +x towards +y and an elevation, degrees. */
function directionFromAngles(azimuth, elevation) {
  const a = (azimuth * Math.PI) / 180, e = (elevation * Math.PI) / 180;
  return [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)];
}

/** The four nearest cells of an octahedral map of side x side directions, and their shares: [[index, share] x 4].
 * Beyond an edge the map goes on at the mirrored place of the same edge. */
function octahedralCells([x, y, z], side) {
  const sum = Math.abs(x) + Math.abs(y) + Math.abs(z);
  let u = x / sum, v = y / sum;
  if (z < 0) [u, v] = [(1 - Math.abs(v)) * (u < 0 ? -1 : 1), (1 - Math.abs(u)) * (v < 0 ? -1 : 1)];
  const column = ((u + 1) / 2) * side - 0.5, row = ((v + 1) / 2) * side - 0.5;
  const left = Math.floor(column), top = Math.floor(row), right = column - left, down = row - top;
  const index = (i, j) => {
    if (i < 0 || i >= side) [i, j] = [i < 0 ? -1 - i : 2 * side - 1 - i, side - 1 - j];
    if (j < 0 || j >= side) [i, j] = [side - 1 - i, j < 0 ? -1 - j : 2 * side - 1 - j];
    return j * side + i;
  };
  return [
    [index(left, top), (1 - right) * (1 - down)],
    [index(left + 1, top), right * (1 - down)],
    [index(left, top + 1), (1 - right) * down],
    [index(left + 1, top + 1), right * down],
  ];
}

/** The nearest cell of such a map. */
function nearestCell(x, y, z, side) {
  const sum = Math.abs(x) + Math.abs(y) + Math.abs(z);
  const across = x / sum, along = y / sum;
  const u = z < 0 ? (1 - Math.abs(along)) * (across < 0 ? -1 : 1) : across;
  const v = z < 0 ? (1 - Math.abs(across)) * (along < 0 ? -1 : 1) : along;
  const column = Math.min(Math.floor(((u + 1) / 2) * side), side - 1);
  return Math.min(Math.floor(((v + 1) / 2) * side), side - 1) * side + column;
}

/** A row of a table [directions, width] at a direction, interpolated. */
function interpolateRow(table, side, width, sun) {
  const row = new Float32Array(width);
  for (const [cell, share] of octahedralCells(sun, side))
    for (let i = 0; i < width; i++) row[i] += share * table[cell * width + i];
  return row;
}

/** The share that the Earth leaves of a Sun 1 au away: before its disc the limb is a straight line. */
function pastEarth(sun, { direction, radius }) {
  const c = Math.acos(Math.min(Math.max(sun.reduce((sum, s, i) => sum + s * direction[i], 0), -1), 1));
  const x = Math.min(Math.max((c - radius) / 0.0046505, -1), 1);
  return 0.5 + (x * Math.sqrt(1 - x * x) + Math.asin(x)) / Math.PI;
}

/** Write what a Sun gives each Gaussian into `front` and `back` [N, 4]: light that bounces onto the side to which its
 * normal points, and onto the other; in front's alpha how much of the Sun it sees. */
function lightUp(about, arrays, sun, front, back) {
  const { count, shadows, bounce } = about;
  for (let i = 0; i < count; i++) front[4 * i + 3] = 1;
  if (shadows) {
    const cells = octahedralCells(sun, shadows.side), stride = (shadows.side * shadows.side) / 2;
    for (let i = 0; i < count; i++) {
      let seen = 0; // two directions a byte, 0 to 15 each
      for (const [cell, share] of cells)
        seen += share * ((arrays.visibility[i * stride + (cell >> 1)] >> (4 * (cell & 1))) & 15);
      front[4 * i + 3] = seen / 15;
    }
  }
  if (bounce) {
    const weights = interpolateRow(arrays.bounce_table, bounce.side, bounce.components, sun);
    const root = new Float32Array(6);
    for (let i = 0; i < count; i++) {
      root.fill(0);
      for (let k = 0; k < bounce.components; k++)
        for (let c = 0; c < 6; c++) root[c] += (weights[k] / 127) * arrays.bounce[6 * (k * count + i) + c];
      for (let c = 0; c < 3; c++) {
        front[4 * i + c] = Math.max(root[c], 0) ** 2;
        back[4 * i + c] = Math.max(root[3 + c], 0) ** 2;
      }
    }
  }
}
