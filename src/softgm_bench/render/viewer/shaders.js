// GLSL ES 3.00. Light: a sun with a shadow map, a sky, and the rod's occlusion of both from a few spheres along it.

const LIGHT_GLSL = `
precision highp float;
precision highp sampler2DShadow;
uniform vec3 u_eye, u_sun, u_sky, u_ground;
uniform mat4 u_light;
uniform sampler2DShadow u_shadow;
uniform vec4 u_spheres[16];

float lit(vec3 world, vec3 normal) {
  vec4 p = u_light * vec4(world + 0.006 * normal, 1.0);
  vec3 q = 0.5 * p.xyz / p.w + 0.5;
  if (any(greaterThan(abs(q - 0.5), vec3(0.5)))) return 1.0;
  float sum = 0.0;
  for (int x = -1; x <= 1; x++)
    for (int y = -1; y <= 1; y++)
      sum += texture(u_shadow, q + vec3(vec2(x, y) * 1.4 / 2048.0, -0.0006));
  return sum / 9.0;
}

// Inigo Quilez, "sphere ambient occlusion"
float open(vec3 world, vec3 normal) {
  float free = 1.0;
  for (int i = 0; i < 16; i++) {
    vec3 d = u_spheres[i].xyz - world;
    float l = max(length(d), 1e-4), r = min(u_spheres[i].w, 0.95 * l);
    free *= 1.0 - max(0.0, dot(normal, d) / l) * (r * r) / (l * l);
  }
  return free;
}

vec3 shaded(vec3 colour, vec3 n, vec3 world, float glow, float gloss, float ao) {
  vec3 albedo = pow(colour, vec3(2.2)), v = normalize(u_eye - world), h = normalize(u_sun + v);
  float seen = dot(n, u_sun) > 0.0 ? lit(world, n) : 0.0, sun = max(0.0, dot(n, u_sun)) * seen;
  vec3 sky = mix(u_ground, u_sky, 0.5 + 0.5 * n.z);
  float fill = 0.18 * max(0.0, dot(n, v));
  float edge = pow(1.0 - max(0.0, dot(n, v)), 4.0);
  vec3 light = albedo * (1.0 * sun + (sky + fill) * ao) + 0.14 * edge * sky * ao;
  light += gloss * pow(max(0.0, dot(n, h)), 40.0) * seen * 0.8;
  light = mix(light, albedo * 1.15, glow);
  return pow(light / (1.0 + 0.12 * light), vec3(1.0 / 2.2));
}
`;

const EMPTY_GLSL = `#version 300 es
precision highp float;
void main() {}`;

// See-through things throw a fourth of a shadow: one texel in four, which the soft lookup blurs.
const SHADOW_FRAGMENT = `#version 300 es
precision highp float;
in vec4 v_colour;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy) & 1;
  if (v_colour.a < 0.99 && at.x + at.y > 0) discard;
}`;

const TUBE_VERTEX = `#version 300 es
precision highp float;
in vec2 a_grid;
uniform mat4 u_camera;
uniform highp sampler2D u_rings;
out vec3 v_world, v_normal;
out float v_arc, v_angle, v_contact;
void main() {
  int ring = int(a_grid.x);
  vec4 centre = texelFetch(u_rings, ivec2(ring, 0), 0), first = texelFetch(u_rings, ivec2(ring, 1), 0);
  vec4 second = texelFetch(u_rings, ivec2(ring, 2), 0), tangent = texelFetch(u_rings, ivec2(ring, 3), 0);
  vec3 radial = cos(a_grid.y) * first.xyz + sin(a_grid.y) * second.xyz;
  float slope = tangent.w;
  v_world = centre.xyz + centre.w * radial;
  v_normal = normalize(sqrt(max(0.0, 1.0 - slope * slope)) * radial + slope * tangent.xyz);
  v_arc = first.w; v_contact = second.w; v_angle = a_grid.y;
  gl_Position = u_camera * vec4(v_world, 1.0);
}`;

const TUBE_FRAGMENT = `#version 300 es
${LIGHT_GLSL}
in vec3 v_world, v_normal;
in float v_arc, v_angle, v_contact;
uniform sampler2D u_arm;
uniform int u_agents;
uniform float u_length;
uniform vec3 u_touch, u_ring, u_tip;
uniform vec4 u_ghost;
out vec4 o_colour;
void main() {
  if (u_ghost.a > 0.0) { o_colour = u_ghost; return; }
  float place = v_arc * float(u_agents + 1), nearest = floor(place + 0.5), w = fwidth(v_arc) * u_length;
  vec3 colour = texture(u_arm, vec2(min(v_arc, 0.999), 0.5)).rgb;
  colour = mix(colour, u_touch, 0.7 * v_contact);
  float ring = abs(place - nearest) * u_length / float(u_agents + 1);
  if (nearest > 0.5 && nearest < float(u_agents) + 0.5)
    colour = mix(colour, u_ring, 0.9 * (1.0 - smoothstep(0.004 - w, 0.004 + w, ring)));
  float turn = abs(mod(v_angle + 3.14159265, 6.2831853) - 3.14159265), a = max(fwidth(turn), 1e-4);
  colour = mix(colour, u_ring, 0.3 * (1.0 - smoothstep(0.045, 0.045 + 1.5 * a, turn)));
  if (v_arc > 1.0) colour = u_tip;
  vec3 n = normalize(v_normal);
  o_colour = vec4(shaded(colour, n, v_world, 0.3 * v_contact, 0.22, 1.0), 1.0);
}`;

const SOLID_VERTEX = `#version 300 es
precision highp float;
in vec3 a_turn;      // cos, sin, part of the radius
in vec3 a_profile;   // radii beyond the end, which end, axial part of the normal
in vec4 i_start;     // and length
in vec4 i_axis;      // and radius
in vec4 i_colour;
in vec4 i_look;      // glow, gloss
uniform mat4 u_camera;
out vec3 v_world, v_normal;
out vec4 v_colour, v_look;
void main() {
  vec3 axis = i_axis.xyz, other = abs(axis.z) < 0.9 ? vec3(0, 0, 1) : vec3(1, 0, 0);
  vec3 e1 = normalize(cross(other, axis)), e2 = cross(axis, e1);
  vec3 radial = a_turn.x * e1 + a_turn.y * e2;
  v_world = i_start.xyz + axis * (i_start.w * a_profile.y + i_axis.w * a_profile.x) + i_axis.w * a_turn.z * radial;
  v_normal = normalize(sqrt(max(0.0, 1.0 - a_profile.z * a_profile.z)) * radial + a_profile.z * axis);
  v_colour = i_colour; v_look = i_look;
  gl_Position = u_camera * vec4(v_world, 1.0);
}`;

const SOLID_FRAGMENT = `#version 300 es
${LIGHT_GLSL}
in vec3 v_world, v_normal;
in vec4 v_colour, v_look;
uniform float u_faint;
out vec4 o_colour;
void main() {
  vec3 n = normalize(v_normal), v = normalize(u_eye - v_world);
  float alpha = v_colour.a;
  if (v_look.z > 0.5) alpha *= 0.45 + 1.5 * pow(1.0 - abs(dot(n, v)), 1.6);
  vec3 colour = shaded(v_colour.rgb, n, v_world, v_look.x, v_look.y, open(v_world, n));
  o_colour = vec4(colour, min(alpha, 1.0) * u_faint);
}`;

const LINE_VERTEX = `#version 300 es
precision highp float;
in vec3 i_a, i_b;
in vec4 i_from, i_to;
in float i_width;
uniform mat4 u_camera;
uniform vec2 u_size;
uniform float u_pixel;
out vec4 v_colour;
out float v_side, v_half;
void main() {
  bool end = gl_VertexID > 1, left = (gl_VertexID & 1) == 1;
  vec4 a = u_camera * vec4(i_a, 1.0), b = u_camera * vec4(i_b, 1.0), p = end ? b : a;
  vec2 run = (b.xy / max(b.w, 0.01) - a.xy / max(a.w, 0.01)) * u_size;
  run = length(run) > 1e-5 ? normalize(run) : vec2(1, 0);
  float half_ = 0.5 * i_width * u_pixel + 1.0;
  vec2 offset = vec2(-run.y, run.x) * (left ? half_ : -half_);
  p.xy += offset / u_size * 2.0 * p.w;
  p.z -= 0.0004 * p.w;
  v_colour = end ? i_to : i_from; v_side = left ? half_ : -half_; v_half = half_;
  gl_Position = p;
}`;

const LINE_FRAGMENT = `#version 300 es
precision highp float;
in vec4 v_colour;
in float v_side, v_half;
uniform float u_faint;
out vec4 o_colour;
void main() {
  o_colour = vec4(v_colour.rgb, v_colour.a * u_faint * clamp(v_half - abs(v_side), 0.0, 1.0));
}`;

const FLOOR_VERTEX = `#version 300 es
precision highp float;
uniform mat4 u_camera;
uniform float u_floor;
out vec3 v_world;
void main() {
  vec2 corner = vec2(float(gl_VertexID & 1), float(gl_VertexID >> 1)) * 2.0 - 1.0;
  v_world = vec3(corner * 12.0, u_floor);
  gl_Position = u_camera * vec4(v_world, 1.0);
}`;

const FLOOR_FRAGMENT = `#version 300 es
${LIGHT_GLSL}
in vec3 v_world;
uniform vec3 u_back, u_line, u_middle;
uniform float u_reach, u_dark;
out vec4 o_colour;
float ruled(vec2 p) {
  vec2 w = fwidth(p), d = abs(fract(p - 0.5) - 0.5) / max(w, 1e-5);
  return (1.0 - min(min(d.x, d.y), 1.0)) * clamp(1.0 - 3.0 * max(w.x, w.y), 0.0, 1.0);
}
void main() {
  float far = length(v_world.xy - u_middle.xy) / u_reach, near = 1.0 - smoothstep(0.55, 1.7, far);
  vec3 colour = mix(u_back, u_line, (0.45 * ruled(v_world.xy * 10.0) + 0.35 * ruled(v_world.xy * 2.0)) * near);
  float shade = 1.0, ao = 1.0;
  if (far < 2.0) {
    shade -= mix(0.26, 0.5, u_dark) * (1.0 - lit(v_world, vec3(0, 0, 1))) * (1.0 - smoothstep(1.4, 2.0, far));
    ao -= 0.6 * (1.0 - open(v_world, vec3(0, 0, 1))) * (1.0 - smoothstep(1.0, 2.0, far));
  }
  o_colour = vec4(colour * shade * ao + 0.035 * u_dark * near, 1.0);
}`;
