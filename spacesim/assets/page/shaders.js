// Gaussians as spacesim's rasterizer draws them, in GLSL: EWA splatting, blended front to back, cut at 1/255.

const WIDTH = 2048; // Gaussians in a row of a texture

const FULL_VERTEX = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }`;

// A fragment a Gaussian: its colour seen from the eye, dimmed by shadow, with the light that bounces onto it.
const SHADE_FRAGMENT = `
uniform sampler2D means, normals, front, back;
uniform mediump sampler2DArray colors;
uniform vec3 eye, sun;
uniform float offset, past; // the Earth: the share of sunlight
out vec4 shown;

vec3 decode(vec3 v) { return mix(v / 12.92, pow((v + 0.055) / 1.055, vec3(2.4)), step(0.04045, v)); }
vec3 encode(vec3 v) { return mix(12.92 * v, 1.055 * pow(v, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, v)); }

vec3 weighted(ivec2 at, int k, vec4 basis) {
  return basis.x * texelFetch(colors, ivec3(at, k), 0).rgb + basis.y * texelFetch(colors, ivec3(at, k + 1), 0).rgb
    + basis.z * texelFetch(colors, ivec3(at, k + 2), 0).rgb + basis.w * texelFetch(colors, ivec3(at, k + 3), 0).rgb;
}

#ifdef COSINES
// Components by sqrt(1 - n.h), n.v and n.s, tabulated, four in a texel, one table behind the other.
uniform highp sampler3D table;
vec3 colorSeen(ivec2 at, vec3 normal, vec3 direction) {
  vec3 between = sun - direction;
  between *= inversesqrt(max(dot(between, between), 1e-12));
  vec3 nodes = vec3(textureSize(table, 0).xy, NODES);
  vec3 node = vec3(sqrt(1.0 - clamp(dot(normal, between), 0.0, 1.0)), -dot(normal, direction), 0.5 + 0.5 * dot(normal, sun));
  vec3 place = clamp(node, 0.0, 1.0) * (nodes - 1.0) + 0.5, total = vec3(0.0);
  for (int k = 0; k < COMPONENTS; k += 4) {
    float depth = place.z + nodes.z * float(k / 4);
    total += weighted(at, k, texture(table, vec3(place.xy / nodes.xy, depth / float(textureSize(table, 0).z))));
  }
  return total;
}
#else
// Components by spherical harmonics of the view; their coefficients change with the Sun.
uniform vec4 table[TERMS * COMPONENTS / 4];
vec3 colorSeen(ivec2 at, vec3 normal, vec3 d) {
  float Y[16];
  float xx = d.x * d.x, yy = d.y * d.y, zz = d.z * d.z;
  Y[0] = 0.28209479;
  Y[1] = -0.48860251 * d.y; Y[2] = 0.48860251 * d.z; Y[3] = -0.48860251 * d.x;
  Y[4] = 1.09254843 * d.x * d.y; Y[5] = -1.09254843 * d.y * d.z; Y[6] = 0.31539157 * (3.0 * zz - 1.0);
  Y[7] = -1.09254843 * d.x * d.z; Y[8] = 0.54627422 * (xx - yy);
  Y[9] = -0.59004359 * d.y * (3.0 * xx - yy); Y[10] = 2.89061144 * d.x * d.y * d.z;
  Y[11] = -0.45704580 * d.y * (5.0 * zz - 1.0); Y[12] = 0.37317633 * d.z * (5.0 * zz - 3.0);
  Y[13] = -0.45704580 * d.x * (5.0 * zz - 1.0); Y[14] = 1.44530572 * d.z * (xx - yy);
  Y[15] = -0.59004359 * d.x * (xx - 3.0 * yy);
  vec3 total = vec3(0.0);
  for (int k = 0; k < COMPONENTS; k += 4) {
    vec4 basis = vec4(0.0);
    for (int l = 0; l < TERMS; l++) basis += Y[l] * table[l * (COMPONENTS / 4) + k / 4];
    total += weighted(at, k, basis);
  }
  return total;
}
#endif

void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  vec3 direction = normalize(texelFetch(means, at, 0).xyz - eye), normal = texelFetch(normals, at, 0).xyz;
  bool turned = dot(normal, direction) > 0.0; // the side is seen to which the normal does not point
  normal *= (turned ? -1.0 : 1.0) * inversesqrt(max(dot(normal, normal), 1e-12));
  vec4 light = texelFetch(front, at, 0);
  vec3 color = max(colorSeen(at, normal, direction) + offset, 0.0) * light.a;
  if (past < 1.0) color = LINEAR ? past * color : encode(past * decode(color));
#ifdef BOUNCE
  vec3 bounced = turned ? texelFetch(back, at, 0).rgb : light.rgb;
  color = LINEAR ? color + bounced : encode(decode(color) + bounced);
#endif
  shown = vec4(color, 1.0);
}`;

// A quad around the ellipse in which a Gaussian's alpha is at least 1/255, along its axes.
const SPLAT_VERTEX = `
uniform sampler2D means, turns, shapes, shaded;
uniform mat3 axes; // camera from world
uniform vec3 eye;
uniform vec4 lens, limits; // focal lengths and principal point, pixels; tangents at which splats are linearized at most
uniform vec2 size; // pixels
uniform highp usampler2D order; // numbers of the Gaussians, near ones first
out vec2 place; // standard deviations from the centre
flat out vec3 color;
flat out float power; // log2 of the opacity

void main() {
  int number = gl_VertexID / 4, corner = gl_VertexID % 4;
  int splat = int(texelFetch(order, ivec2(number % ${WIDTH}, number / ${WIDTH}), 0).r);
  ivec2 at = ivec2(splat % ${WIDTH}, splat / ${WIDTH});
  vec4 q = texelFetch(turns, at, 0), shape = texelFetch(shapes, at, 0);
  vec3 center = axes * (texelFetch(means, at, 0).xyz - eye), scale = exp(shape.xyz);
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0); // not drawn
  if (center.z <= 0.01) return;
  q /= length(q);
  float w = q.x, x = q.y, y = q.z, z = q.w;
  mat3 turn = mat3(
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
  mat3 m = transpose(axes * turn); // rows of camera axes in the Gaussian's own
  vec2 tangent = center.xy / center.z, slope = clamp(tangent, limits.xy, limits.zw);
  vec3 mx = lens.x / center.z * scale * (m[0] - slope.x * m[2]), my = lens.y / center.z * scale * (m[1] - slope.y * m[2]);
  vec3 normal = cross(mx, my);
  float own = dot(normal, normal), xx = dot(mx, mx), yy = dot(my, my), xy = dot(mx, my);
  float determinant = own + SPREAD * (xx + yy + SPREAD);
  xx += SPREAD; yy += SPREAD;
  float opacity = 1.0 / (1.0 + exp(-shape.w));
#ifdef ANTIALIASED
  opacity *= sqrt(own / determinant);
#endif
  if (!(opacity >= 1.0 / 255.0)) return;
  float reach = sqrt(2.0 * log(255.0 * opacity));
  float half_difference = 0.5 * (xx - yy), radius = length(vec2(half_difference, xy));
  float longer = 0.5 * (xx + yy) + radius, shorter = determinant / longer;
  float cosine = radius > 0.0 ? half_difference / radius : 1.0; // of twice the angle of the longer axis
  vec2 along = vec2(sqrt(0.5 + 0.5 * cosine), (xy < 0.0 ? -1.0 : 1.0) * sqrt(max(0.5 - 0.5 * cosine, 0.0)));
  place = reach * (2.0 * vec2(corner & 1, corner >> 1) - 1.0);
  vec2 pixel = lens.xy * tangent + lens.zw + place.x * sqrt(longer) * along;
  pixel += place.y * sqrt(shorter) * vec2(-along.y, along.x);
  color = texelFetch(shaded, at, 0).rgb;
  power = log2(opacity);
  gl_Position = vec4(2.0 * pixel.x / size.x - 1.0, 1.0 - 2.0 * pixel.y / size.y, 0.0, 1.0);
}`;

const SPLAT_FRAGMENT = `
in vec2 place;
flat in vec3 color;
flat in float power;
out vec4 shown;
void main() {
  float exponent = power - 0.72134752 * dot(place, place);
  if (exponent < -7.9943534) discard;
  float alpha = min(exp2(exponent), 0.999);
  shown = vec4(alpha * color, alpha);
}`;

// Linear light through the tone curve.
const SHOW_FRAGMENT = `
uniform sampler2D picture;
uniform float white;
out vec4 shown;
void main() {
  vec3 v = texelFetch(picture, ivec2(gl_FragCoord.xy), 0).rgb;
  v *= white;
  if (FILMIC) v = v * (2.51 * v + 0.03) / (v * (2.43 * v + 0.59) + 0.14);
  v = clamp(v, 0.0, 1.0);
  v = mix(12.92 * v, 1.055 * pow(v, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, v));
  shown = vec4(v, 1.0);
}`;
