// How a point looks: its place from four small integers, its colour from a ramp, its shape from what happened to it.

export const MARK = { none: 0, removed: 1, added: 2 };
export const COLOUR = { height: 0, plain: 1, age: 2, votes: 3, probability: 4, state: 5, intensity: 6 };

export const POINT_VERTEX = `
precision highp float;
precision highp int;
uniform mat4 modelViewMatrix, projectionMatrix;
uniform float z0, zStep, spacing, pixels, coarse, ratio;
uniform vec2 slice;
uniform int colour, mark;
uniform sampler2D evidence, ramp;
uniform vec3 ground, plain, removed, added;
in vec4 place;
in float bright;
out vec3 shade;
out float side;

vec3 by_evidence(vec4 told) {
  if (told.x == 0.0) return ground;
  if (colour == 2) return told.y > 0.995 ? ground : texture(ramp, vec2(1.0 - clamp(log2(1.0 + 255.0 * told.y) / 6.0, 0.0, 1.0), 0.5)).rgb;
  if (colour == 3) return texture(ramp, vec2(clamp(255.0 * told.x / 9.0, 0.0, 1.0), 0.5)).rgb;
  if (colour == 4) return texture(ramp, vec2(told.z, 0.5)).rgb;
  float state = floor(255.0 * told.w + 0.5);
  return state == 2.0 ? added : state == 3.0 ? removed : texture(ramp, vec2(0.55, 0.5)).rgb;
}

void main() {
  vec3 local = vec3(place.xy * (76.8 / 65535.0), place.z * zStep + z0);
  float above = place.w / 100.0 - 10.0;
  vec4 seen = modelViewMatrix * vec4(local, 1.0);
  gl_Position = projectionMatrix * seen;
  if (above < slice.x || above > slice.y) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  float size = 1.35 * spacing * coarse * pixels / max(-seen.z, 0.1);
  if (mark == 0) {
    shade = above < 0.25 ? ground : texture(ramp, vec2(clamp(0.06 + above / 15.0, 0.0, 1.0), 0.5)).rgb;
    if (colour == 1) shade = mix(plain, ground, above < 0.25 ? 1.0 : 0.0) * (0.8 + 0.2 * clamp(above / 8.0, 0.0, 1.0));
    if (colour == 6) shade = texture(ramp, vec2(sqrt(bright), 0.5)).rgb;
    else if (colour > 1) shade = by_evidence(texture(evidence, place.xy / 65535.0));
    gl_PointSize = clamp(size, 1.4 * ratio, 9.0 * ratio);
  } else {
    shade = mark == 1 ? removed : added;
    gl_Position.z -= 0.0004 * gl_Position.w;
    gl_PointSize = clamp(1.15 * size, 2.5 * ratio, 11.0 * ratio);
  }
  side = gl_PointSize / ratio;
}`;

// Shape as well as colour: what went is a cross, what came a diamond, as soon as a point is large enough to show it.
export const POINT_FRAGMENT = `
precision highp float;
precision highp int;
uniform int mark;
in vec3 shade;
in float side;
out vec4 colour_out;
void main() {
  vec2 at = abs(2.0 * gl_PointCoord - 1.0);
  if (mark == 1 && side > 4.5 && abs(at.x - at.y) > 0.38) discard;
  if (mark == 2 && side > 4.5 && at.x + at.y > 1.05) discard;
  if (mark == 0 && side > 4.0 && dot(at, at) > 1.0) discard;
  colour_out = vec4(shade, 1.0);
}`;

export const QUAD_VERTEX = `
in vec3 position;
out vec2 at;
void main() { at = 0.5 * position.xy + 0.5; gl_Position = vec4(position.xy, 0.0, 1.0); }`;

// Eye-dome lighting (Boucheny 2009): darker where a neighbour is nearer; it makes a cloud without normals readable.
export const QUAD_FRAGMENT = `
precision highp float;
precision highp int;
uniform sampler2D image, depth;
uniform vec2 pixel, planes;
uniform float strength;
in vec2 at;
out vec4 colour_out;
float far_log(vec2 where) {
  float d = texture(depth, where).r;
  if (d >= 1.0) return 14.0;
  float z = 2.0 * d - 1.0;
  return log2(2.0 * planes.x * planes.y / (planes.y + planes.x - z * (planes.y - planes.x)));
}
void main() {
  vec4 colour = texture(image, at);
  float here = far_log(at), sum = 0.0;
  if (here < 13.0) {
    sum += clamp(here - far_log(at + vec2(pixel.x, 0.0)), 0.0, 0.14);
    sum += clamp(here - far_log(at - vec2(pixel.x, 0.0)), 0.0, 0.14);
    sum += clamp(here - far_log(at + vec2(0.0, pixel.y)), 0.0, 0.14);
    sum += clamp(here - far_log(at - vec2(0.0, pixel.y)), 0.0, 0.14);
  }
  colour_out = vec4(colour.rgb * exp(-strength * sum), colour.a);
}`;

// Stops from low to high, even in lightness and told apart with any kind of colour vision.
export const RAMPS = {
  light: ["#31446b", "#3b6a8f", "#3f8f9b", "#63ad8c", "#b3bd5b", "#e0a63a"],
  dark: ["#41598c", "#4a83ad", "#52a9b1", "#7cc7a0", "#c8d06d", "#f4c04f"],
};
