// What the graphics processor does. Lengths are half-widths of the skin. Light is reckoned with as the square of a colour:
// near to what screens do, and cheap where the processor draws.

const HEAD = `#version 300 es
precision highp float;
uniform mat4 matrix;
uniform vec3 eye, sun;
`;

const VERTEX = `${HEAD}
layout(location = 0) in vec3 place;
layout(location = 1) in vec3 normal;
out vec3 at, facing;
`;

const FRAGMENT = `${HEAD}
in vec3 at, facing;
out vec4 seen;
vec4 lit(vec3 colour, vec3 normal, float gloss) {
  vec3 sky = mix(vec3(0.30, 0.31, 0.36), vec3(0.60, 0.61, 0.64), 0.5 + 0.5 * normal.z);
  float day = 0.62 * max(0.0, dot(normal, sun));
  float near = max(0.0, dot(normal, normalize(sun + normalize(eye - at))));
  for (int k = 0; k < 5; k++) near *= near;
  return vec4(sqrt(colour * colour * (sky + day) + gloss * near), 1.0);
}
`;

/** The sheet: `field` has depth, drop and slopes, `box` its low corner and one over its size. */
export const SHEET = [`${VERTEX}
uniform sampler2D field;
uniform vec4 box;
uniform float depth, thick;
void main() {
  float dent = textureLod(field, (place.xy - box.xy) * box.zw, 0.0).x;
  at = vec3(place.xy, place.z < 0.0 ? -thick : -depth * dent);
  facing = normal;
  gl_Position = matrix * vec4(at, 1.0);
}`, `${FRAGMENT}
uniform sampler2D field, ramp;
uniform vec4 box;
uniform float depth, mesh; // mesh: of the lines on the skin
void main() {
  vec4 here = texture(field, (at.xy - box.xy) * box.zw);
  bool wall = dot(facing, facing) > 0.0;
  vec3 normal = wall ? normalize(facing) : normalize(vec3(depth * here.zw, 1.0));
  vec3 colour = texture(ramp, vec2(wall ? 0.0 : here.y, 0.5)).rgb;
  vec2 line = at.xy / mesh, wide = fwidth(line);
  vec2 near = smoothstep(1.5 * wide, 0.5 * wide, abs(line - round(line)));
  if (!wall) colour = mix(colour, vec3(1.0), 0.13 * max(near.x, near.y));
  seen = lit(wall ? 0.8 * colour : colour, normal, wall ? 0.0 : 0.05);
}`];

/** Anything of one colour, moved to `origin`; `axes`, which stand on each other, turn and stretch it. */
export const SOLID = [`${VERTEX}
uniform vec3 origin;
uniform mat3 axes;
void main() {
  at = origin + axes * place;
  facing = axes * (normal / vec3(dot(axes[0], axes[0]), dot(axes[1], axes[1]), dot(axes[2], axes[2])));
  gl_Position = matrix * vec4(at, 1.0);
}`, `${FRAGMENT}
uniform vec3 colour;
void main() { seen = lit(colour, normalize(facing), 0.25); }`];

/** On the ground below the sheet, from -wide to wide: `shade` has how much light is taken there. */
export const SHADOW = [`${VERTEX}
uniform float thick, wide;
void main() {
  at = vec3(place.xy * wide, -thick - 0.02);
  facing = place;
  gl_Position = matrix * vec4(at, 1.0);
}`, `${FRAGMENT}
uniform sampler2D shade;
void main() { seen = vec4(0.0, 0.0, 0.0, 0.36 * smoothstep(0.05, 1.0, texture(shade, 0.5 + 0.5 * facing.xy).x)); }`];
