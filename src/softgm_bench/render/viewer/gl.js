// The scene with WebGL 2.

const SHADOW = 2048;
const FLOATS = { solid: 16, line: 15 };
// The same in every program, since programs share vertex arrays.
const PLACES = {
  a_grid: 0, a_turn: 0, a_profile: 1, i_start: 2, i_axis: 3, i_colour: 4, i_look: 5,
  i_a: 0, i_b: 1, i_from: 2, i_to: 3, i_width: 4,
};

// Surfaces of revolution: rows of (part of the radius, radii beyond the end, which end, axial part of the normal).
function lathe(rows, sides = 40) {
  const vertices = [];
  const triangles = [];
  rows.forEach((row) => {
    for (let i = 0; i <= sides; i++) {
      const angle = (2 * Math.PI * i) / sides;
      vertices.push(Math.cos(angle), Math.sin(angle), ...row);
    }
  });
  for (let k = 0; k + 1 < rows.length; k++) {
    for (let i = 0; i < sides; i++) {
      const [a, b] = [k * (sides + 1) + i, (k + 1) * (sides + 1) + i];
      triangles.push(a, a + 1, b, b, a + 1, b + 1);
    }
  }
  return { vertices: new Float32Array(vertices), triangles: new Uint16Array(triangles) };
}

function capsuleRows() {
  const rows = [];
  const caps = 10;
  for (let k = 0; k <= caps; k++) {
    const angle = ((k / caps - 1) * Math.PI) / 2;
    rows.push([Math.cos(angle), Math.sin(angle), 0, Math.sin(angle)]);
  }
  for (let k = 0; k <= caps; k++) {
    const angle = ((k / caps) * Math.PI) / 2;
    rows.push([Math.cos(angle), Math.sin(angle), 1, Math.sin(angle)]);
  }
  return rows;
}

const MESHES = {
  capsule: capsuleRows(),
  band: [[0.9, 0, 0, -0.999], [1, 0, 0, -0.999], [1, 0, 0, 0], [1, 0, 1, 0], [1, 0, 1, 0.999], [0.9, 0, 1, 0.999]],
  drum: [[0, 0, 0, -0.999], [1, 0, 0, -0.999], [1, 0, 0, 0], [1, -0.06, 1, 0], [0.94, 0, 1, 0.8], [0.94, 0, 1, 0.999], [0, 0, 1, 0.999]],
  pedestal: [[1.25, 0, 0, 0.1], [1.1, 0, 1, 0.1], [1.1, 0, 1, 0.999], [0, 0, 1, 0.999]],
  cone: [[0, 0, 0, -0.999], [1, 0, 0, -0.999], [1, 0, 0, 0.35], [0, 0, 1, 0.35]],
};

class GlRenderer {
  constructor(canvas, episode, bounds) {
    const gl = canvas.getContext("webgl2", { antialias: true, alpha: false, powerPreference: "high-performance" });
    if (!gl) throw new Error("WebGL 2 is missing");
    Object.assign(this, { canvas, gl, episode, bounds });
    this.programs = {
      tube: this.program(TUBE_VERTEX, TUBE_FRAGMENT), tubeShadow: this.program(TUBE_VERTEX, EMPTY_GLSL),
      solid: this.program(SOLID_VERTEX, SOLID_FRAGMENT), solidShadow: this.program(SOLID_VERTEX, SHADOW_FRAGMENT),
      line: this.program(LINE_VERTEX, LINE_FRAGMENT), floor: this.program(FLOOR_VERTEX, FLOOR_FRAGMENT),
    };
    this.instances = gl.createBuffer();
    this.meshes = Object.fromEntries(Object.entries(MESHES).map(([name, rows]) => [name, this.mesh(lathe(rows))]));
    this.tube = this.tubeMesh();
    this.lines = gl.createVertexArray();
    this.plain = gl.createVertexArray();
    this.rings = this.texture(gl.TEXTURE_2D);
    this.arm = this.texture(gl.TEXTURE_2D);
    const colours = Array.from({ length: 512 }, (_, i) => [...armColour((i + 0.5) / 512, episode.agents), 1]).flat();
    const bytes = Uint8Array.from(colours, (x) => Math.round(255 * x));
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, 512, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    this.makeShadow();
    // from the upper left, before the scene, as the default camera sees it
    const azimuth = (episode.camera.azimuth * Math.PI) / 180;
    const [c, s] = [Math.cos(azimuth), Math.sin(azimuth)];
    this.sun = unit([0.35 * s + 0.62 * c, -0.35 * c + 0.62 * s, 1.0]);
    const eye = along(bounds.centre, this.sun, 2 * bounds.reach);
    this.light = product(orthographic(1.05 * bounds.reach, 0.1, 4 * bounds.reach), lookAt(eye, bounds.centre, [0, 1, 0]));
  }

  program(vertex, fragment) {
    const { gl } = this;
    const program = gl.createProgram();
    for (const [type, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(type);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    for (const [name, place] of Object.entries(PLACES)) gl.bindAttribLocation(program, place, name);
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) throw new Error(gl.getProgramInfoLog(program));
    const places = {};
    return {
      program,
      place: (name) => (name in places ? places[name] : (places[name] = gl.getUniformLocation(program, name))),
    };
  }

  texture(target) {
    const { gl } = this;
    const texture = gl.createTexture();
    gl.bindTexture(target, texture);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(target, name, gl.NEAREST);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(target, name, gl.CLAMP_TO_EDGE);
    return texture;
  }

  makeShadow() {
    const { gl } = this;
    this.shadow = this.texture(gl.TEXTURE_2D);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.DEPTH_COMPONENT24, SHADOW, SHADOW);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_COMPARE_MODE, gl.COMPARE_REF_TO_TEXTURE);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.LINEAR);
    this.shadowTarget = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.shadowTarget);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, this.shadow, 0);
    gl.drawBuffers([gl.NONE]);
    gl.readBuffer(gl.NONE);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  buffer(target, data) {
    const { gl } = this;
    const buffer = gl.createBuffer();
    gl.bindBuffer(target, buffer);
    gl.bufferData(target, data, gl.STATIC_DRAW);
    return buffer;
  }

  // Attributes that lie one behind the other in the bound buffer.
  attributes(entries, stride, divisor) {
    const { gl } = this;
    let at = 0;
    for (const [name, size] of entries) {
      gl.enableVertexAttribArray(PLACES[name]);
      gl.vertexAttribPointer(PLACES[name], size, gl.FLOAT, false, 4 * stride, 4 * at);
      gl.vertexAttribDivisor(PLACES[name], divisor);
      at += size;
    }
  }

  mesh({ vertices, triangles }) {
    const { gl } = this;
    const vao = gl.createVertexArray();
    gl.bindVertexArray(vao);
    const buffer = this.buffer(gl.ARRAY_BUFFER, vertices);
    this.buffer(gl.ELEMENT_ARRAY_BUFFER, triangles);
    gl.bindVertexArray(null);
    return { vao, buffer, count: triangles.length };
  }

  tubeMesh() {
    const rings = ringsOf(this.episode.elements);
    const grid = [];
    const triangles = [];
    for (let ring = 0; ring < rings; ring++) {
      for (let i = 0; i <= SIDES; i++) grid.push(ring, (2 * Math.PI * i) / SIDES);
    }
    for (let ring = 0; ring + 1 < rings; ring++) {
      for (let i = 0; i < SIDES; i++) {
        const [a, b] = [ring * (SIDES + 1) + i, (ring + 1) * (SIDES + 1) + i];
        triangles.push(a, a + 1, b, b, a + 1, b + 1);
      }
    }
    return this.mesh({ vertices: new Float32Array(grid), triangles: new Uint32Array(triangles) });
  }

  use(program, camera) {
    const { gl } = this;
    gl.useProgram(program.program);
    gl.uniformMatrix4fv(program.place("u_camera"), false, camera);
  }

  lightUniforms(program) {
    const { gl, theme } = this;
    gl.uniform3fv(program.place("u_eye"), this.eye);
    gl.uniform3fv(program.place("u_sun"), this.sun);
    gl.uniform3fv(program.place("u_sky"), theme.dark ? [0.3, 0.34, 0.42] : [0.5, 0.53, 0.58]);
    gl.uniform3fv(program.place("u_ground"), theme.dark ? [0.1, 0.1, 0.12] : [0.24, 0.23, 0.23]);
    gl.uniformMatrix4fv(program.place("u_light"), false, this.light);
    gl.uniform4fv(program.place("u_spheres"), this.spheres);
    gl.uniform1i(program.place("u_shadow"), 0);
    gl.uniform1i(program.place("u_rings"), 1);
    gl.uniform1i(program.place("u_arm"), 2);
  }

  drawTube(program) {
    const { gl } = this;
    gl.uniform1i(program.place("u_rings"), 1);
    gl.bindVertexArray(this.tube.vao);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.tube.buffer);
    this.attributes([["a_grid", 2]], 2, 0);
    gl.drawElements(gl.TRIANGLES, this.tube.count, gl.UNSIGNED_INT, 0);
  }

  drawSolids(solids) {
    const { gl } = this;
    for (const [name, mesh] of Object.entries(this.meshes)) {
      const chosen = solids.filter((solid) => solid.mesh === name);
      if (!chosen.length) continue;
      const data = new Float32Array(FLOATS.solid * chosen.length);
      chosen.forEach((s, k) => {
        const row = [...s.start, s.size, ...s.axis, s.radius, ...s.colour, s.alpha, s.glow, s.gloss, s.shell ? 1 : 0, 0];
        data.set(row, FLOATS.solid * k);
      });
      gl.bindVertexArray(mesh.vao);
      gl.bindBuffer(gl.ARRAY_BUFFER, mesh.buffer);
      this.attributes([["a_turn", 3], ["a_profile", 3]], 6, 0);
      gl.bindBuffer(gl.ARRAY_BUFFER, this.instances);
      gl.bufferData(gl.ARRAY_BUFFER, data, gl.STREAM_DRAW);
      this.attributes([["i_start", 4], ["i_axis", 4], ["i_colour", 4], ["i_look", 4]], FLOATS.solid, 1);
      gl.drawElementsInstanced(gl.TRIANGLES, mesh.count, gl.UNSIGNED_SHORT, 0, chosen.length);
    }
  }

  drawLines(segments, camera, faint) {
    if (!segments.length) return;
    const { gl } = this;
    const program = this.programs.line;
    this.use(program, camera);
    gl.uniform2f(program.place("u_size"), this.canvas.width, this.canvas.height);
    gl.uniform1f(program.place("u_pixel"), this.ratio);
    gl.uniform1f(program.place("u_faint"), faint);
    const data = new Float32Array(FLOATS.line * segments.length);
    segments.forEach((s, k) => data.set([...s.a, ...s.b, ...s.from, ...s.to, s.width], FLOATS.line * k));
    gl.bindVertexArray(this.lines);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.instances);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STREAM_DRAW);
    this.attributes([["i_a", 3], ["i_b", 3], ["i_from", 4], ["i_to", 4], ["i_width", 1]], FLOATS.line, 1);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, segments.length);
  }

  upload(rod) {
    const { gl, episode } = this;
    const { rings, texture } = skin(rod, episode.elements);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, this.rings);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, rings, 4, 0, gl.RGBA, gl.FLOAT, texture);
    gl.activeTexture(gl.TEXTURE2);
    gl.bindTexture(gl.TEXTURE_2D, this.arm);
    this.spheres = new Float32Array(64);
    for (let k = 0; k < 16; k++) {
      const node = Math.round((k / 15) * episode.elements);
      this.spheres.set([...vec(rod.position, 3 * node), rod.radius[Math.min(node, episode.elements - 1)]], 4 * k);
    }
  }

  drawShadow(solids) {
    const { gl, programs } = this;
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, null);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.shadowTarget);
    gl.viewport(0, 0, SHADOW, SHADOW);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    this.use(programs.tubeShadow, this.light);
    this.drawTube(programs.tubeShadow);
    this.use(programs.solidShadow, this.light);
    this.drawSolids(solids.filter((solid) => solid.shadow && !solid.shell));
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.bindTexture(gl.TEXTURE_2D, this.shadow);
  }

  drawFloor(camera) {
    const { gl, theme, bounds } = this;
    const program = this.programs.floor;
    this.use(program, camera);
    this.lightUniforms(program);
    gl.uniform1f(program.place("u_floor"), bounds.floor);
    gl.uniform1f(program.place("u_reach"), bounds.reach);
    gl.uniform1f(program.place("u_dark"), theme.dark ? 1 : 0);
    gl.uniform3fv(program.place("u_back"), theme.back);
    gl.uniform3fv(program.place("u_line"), theme.dark ? mixed(theme.line, theme.soft, 0.3) : mixed(theme.line, theme.soft, 0.45));
    gl.uniform3fv(program.place("u_middle"), bounds.centre);
    gl.bindVertexArray(this.plain);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
  }

  // frame: rod, solids, path, edges; all in world coordinates.
  draw(frame, view, theme, ratio) {
    const { gl, programs, episode } = this;
    Object.assign(this, { theme, ratio, eye: view.eye });
    const camera = view.viewProjection;
    this.upload(frame.rod);
    gl.enable(gl.DEPTH_TEST);
    gl.disable(gl.BLEND);
    gl.depthMask(true);
    gl.depthFunc(gl.LEQUAL);
    this.drawShadow(frame.solids);

    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.clearColor(...theme.back, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    if (view.eye[2] > this.bounds.floor) this.drawFloor(camera);
    const [solid, tube] = [programs.solid, programs.tube];
    const opaque = frame.solids.filter((s) => s.alpha === 1);
    const shell = frame.solids.filter((s) => s.alpha < 1 && s.shell);
    const clear = frame.solids.filter((s) => s.alpha < 1 && !s.shell);
    const faint = (value) => gl.uniform1f(solid.place("u_faint"), value);
    this.use(solid, camera);
    this.lightUniforms(solid);
    faint(1);
    this.drawSolids(opaque);

    // what obstacles hide shows through, faintly
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.enable(gl.CULL_FACE);
    gl.depthMask(false);
    gl.depthFunc(gl.GREATER);
    faint(0.4);
    this.drawSolids(shell);
    this.use(tube, camera);
    this.lightUniforms(tube);
    gl.uniform1i(tube.place("u_agents"), episode.agents);
    gl.uniform1f(tube.place("u_length"), episode.baseLength);
    gl.uniform3fv(tube.place("u_touch"), PAINT.touch);
    gl.uniform3fv(tube.place("u_ring"), PAINT.ring);
    gl.uniform3fv(tube.place("u_tip"), frame.reached ? PAINT.reached : PAINT.tip);
    gl.uniform4f(tube.place("u_ghost"), ...mixed(PAINT.arm[1], theme.back, 0.2), 0.2);
    this.drawTube(tube);

    gl.depthFunc(gl.LEQUAL);
    gl.depthMask(true);
    gl.disable(gl.CULL_FACE);
    gl.disable(gl.BLEND);
    gl.uniform4f(tube.place("u_ghost"), 0, 0, 0, 0);
    this.drawTube(tube);

    // of see-through things only the nearest surface, whose depth comes first
    if (clear.length) {
      this.use(solid, camera);
      gl.colorMask(false, false, false, false);
      this.drawSolids(clear);
      gl.colorMask(true, true, true, true);
      gl.enable(gl.BLEND);
      faint(1);
      this.drawSolids(clear);
    }
    gl.enable(gl.BLEND);
    gl.depthMask(false);
    gl.depthFunc(gl.GREATER);
    this.drawLines([...frame.path, ...frame.edges], camera, 0.3);
    gl.depthFunc(gl.LEQUAL);
    this.drawLines([...frame.path, ...frame.edges], camera, 1);
    gl.enable(gl.CULL_FACE);
    this.use(solid, camera);
    faint(1);
    this.drawSolids(shell);
    if (clear.length) {
      gl.depthFunc(gl.GREATER);
      faint(0.8);
      this.drawSolids(shell);
    }
    gl.disable(gl.CULL_FACE);
    gl.depthMask(true);
  }
}
