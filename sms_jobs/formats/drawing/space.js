// The surface of a view in space, by WebGL 2: turned, moved, deformed as many times as one likes.

const VERTEX = `#version 300 es
in vec3 place; in vec3 shift; in vec3 tint;
uniform mat3 turn; uniform vec3 middle; uniform vec2 pan; uniform vec3 stretch; uniform float times;
out vec3 eye; out vec3 colour;
void main() {
  eye = turn * (place + times * shift - middle);
  colour = tint;
  gl_Position = vec4(eye.xy * stretch.xy + pan, -eye.z * stretch.z, 1.0);
}`;
const FRAGMENT = `#version 300 es
precision highp float;
in vec3 eye; in vec3 colour; out vec4 shown;
void main() {
  vec3 normal = normalize(cross(dFdx(eye), dFdy(eye)));
  shown = vec4(colour * (0.5 + 0.5 * abs(normal.z)), 1.0);
}`;
const BROKEN = 8; // an edge so many times as long as the middle one crosses a discontinuity
const NEAR_PX = 12;
let opened = null;

function openSpace(view) {
  closeSpace();
  const canvas = made("canvas", { class: "space", tabindex: 0, role: "application",
    "aria-label": `Surface of ${view.about.title}, state ${view.about.state}. Arrow keys turn it, plus and minus zoom, 0 brings it back.` });
  const gl = canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true });
  if (gl) opened = new Space(view, canvas, gl);
  else view.read.textContent = "This browser shows no WebGL 2, which the surface in space needs; the map tells the same.";
}

function closeSpace() {
  if (opened) opened.close();
  opened = null;
}

function product(a, b) {
  return a.map((_, i) => {
    const row = Math.floor(i / 3) * 3, column = i % 3;
    return a[row] * b[column] + a[row + 1] * b[3 + column] + a[row + 2] * b[6 + column];
  });
}

function applied(m, v) {
  return [0, 3, 6].map((r) => m[r] * v[0] + m[r + 1] * v[1] + m[r + 2] * v[2]);
}

function about(axis, angle) {
  const c = Math.cos(angle), s = Math.sin(angle);
  return axis === "x" ? [1, 0, 0, 0, c, -s, 0, s, c] : [c, 0, s, 0, 1, 0, -s, 0, c];
}

class Space {
  constructor(view, canvas, gl) {
    this.view = view; view.space = this; this.canvas = canvas; this.gl = gl;
    this.times = view.about.movement ? 1 : 0; this.most = 1; this.zoom = 1; this.pan = [0, 0]; this.turn = null;
    this.marks = ["X", "Y", "Z"].map((name) => made("span", { class: "axis-name", "aria-hidden": "true" }, name));
    view.turn.setAttribute("aria-pressed", "true");
    view.canvas.hidden = true;
    view.picture.append(this.canvas, ...this.marks);
    this.listen();
    this.slider();
    this.load();
  }

  slider() {
    if (!this.view.about.movement) return;
    const shown = made("output", {}, "1");
    const input = made("input", { type: "range", min: 0, max: 100, value: 0, oninput: () => {
      this.times = Number(((Number(input.value) / 100) ** 2 * this.most).toPrecision(2));
      shown.textContent = String(this.times);
      this.draw();
    } });
    this.bar = made("div", { class: "controls" }, made("label", {}, "displacement, times ", input, shown));
    this.input = input;
    this.view.picture.before(this.bar);
  }

  listen() {
    new Pointing(this.canvas, {
      move: (x, y) => this.touch(x, y),
      click: (x, y) => { this.touch(x, y); if (this.view.cursor) this.view.pick(this.view.cursor); },
      drag: (dx, dy, event) => {
        if (event.shiftKey || event.buttons === 2) this.shift(dx, dy);
        else this.rotate(dx / 120, dy / 120);
      },
      zoom: (factor) => this.zoomBy(factor),
      free: () => true,
    });
    this.canvas.addEventListener("keydown", (event) => {
      const turns = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] };
      if (turns[event.key]) this.rotate(...turns[event.key]);
      else if (event.key === "+" || event.key === "=") this.zoomBy(1.25);
      else if (event.key === "-") this.zoomBy(0.8);
      else if (event.key === "0") this.reset();
      else return;
      event.preventDefault();
    });
    this.watch = new ResizeObserver(() => this.draw());
    this.watch.observe(this.view.picture);
  }

  async load() {
    const { fields, about } = this.view;
    this.position = await fields.vectors(about.position);
    this.movement = await fields.vectors(about.movement);
    if (opened !== this) return;
    this.measure();
    this.compile();
    this.colour();
  }

  // The middle, the size, and the directions of the image on the surface: first it is seen as by the camera.
  measure() {
    const [X, Y, Z] = this.position, { rows, columns } = this.view.fields, count = X.length;
    const low = [Infinity, Infinity, Infinity], high = low.map((v) => -v);
    const along = [[0, 0, 0], [0, 0, 0]], edges = [];
    for (let i = 0; i < count; i++) {
      if (X[i] !== X[i]) continue;
      const p = [X[i], Y[i], Z[i]];
      for (let k = 0; k < 3; k++) { low[k] = Math.min(low[k], p[k]); high[k] = Math.max(high[k], p[k]); }
      for (const [k, next] of [[0, (i + 1) % columns ? i + 1 : -1], [1, i + columns < count ? i + columns : -1]]) {
        if (next < 0 || X[next] !== X[next]) continue;
        const edge = [X[next] - p[0], Y[next] - p[1], Z[next] - p[2]];
        edge.forEach((v, axis) => { along[k][axis] += v; });
        if (i % 7 === 0) edges.push(Math.hypot(...edge));
      }
    }
    edges.sort((a, b) => a - b);
    this.longest = BROKEN * (edges[edges.length >> 1] || 1);
    this.middle = low.map((v, k) => (v + high[k]) / 2);
    this.radius = 0.5 * Math.hypot(...low.map((v, k) => high[k] - v)) || 1;
    const unit = (v) => { const n = Math.hypot(...v) || 1; return v.map((c) => c / n); };
    const right = unit(along[0]), dot = right.reduce((s, c, k) => s + c * along[1][k], 0);
    const down = unit(along[1].map((c, k) => c - dot * right[k]));
    const [a, b] = [right, down];
    const away = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    this.camera = [...right, ...down.map((v) => -v), ...away.map((v) => -v)];
    this.turn = this.camera;
    let largest = 0;
    if (this.movement) for (let i = 0; i < count; i++) {
      const d = Math.hypot(this.movement[0][i], this.movement[1][i], this.movement[2][i]);
      if (d > largest) largest = d;
    }
    this.most = largest ? Math.max(1, Number((this.radius / largest).toPrecision(1))) : 1;
    if (this.input) this.input.value = String(Math.round(100 * Math.sqrt(1 / this.most)));
    this.triangles = this.faces(rows, columns);
  }

  faces(rows, columns) {
    const [X, Y, Z] = this.position, limit = this.longest, found = [];
    const whole = (a, b, c) => [[a, b], [b, c], [c, a]].every(([p, q]) =>
      Math.hypot(X[p] - X[q], Y[p] - Y[q], Z[p] - Z[q]) <= limit);
    for (let row = 0; row + 1 < rows; row++) for (let column = 0; column + 1 < columns; column++) {
      const a = row * columns + column, b = a + 1, c = a + columns, d = c + 1;
      if (whole(a, c, b)) found.push(a, c, b);
      if (whole(b, c, d)) found.push(b, c, d);
    }
    return new Uint32Array(found);
  }

  compile() {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text); gl.compileShader(shader); gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    gl.useProgram(program);
    this.program = program;
    const woven = (parts) => {
      const all = new Float32Array(3 * this.position[0].length);
      // Relative to the middle, since single precision keeps seven digits.
      if (parts) parts.forEach((values, k) => values.forEach((v, i) => { all[3 * i + k] = v === v ? v : 0; }));
      return all;
    };
    this.buffer("place", woven(this.position.map((values, k) => values.map((v) => v - this.middle[k]))), gl.FLOAT, false);
    this.buffer("shift", woven(this.movement), gl.FLOAT, false);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, this.triangles, gl.STATIC_DRAW);
    gl.enable(gl.DEPTH_TEST);
  }

  buffer(name, array, type, normalised) {
    const gl = this.gl, place = gl.getAttribLocation(this.program, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, array, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, 3, type, normalised, 0, 0);
  }

  colour() {
    if (!this.program || !this.view.values) return;
    const limits = this.view.shown, tints = new Uint8Array(3 * this.view.values.length);
    this.view.values.forEach((value, i) => tints.set(this.view.colour(value, limits), 3 * i));
    this.buffer("tint", tints, this.gl.UNSIGNED_BYTE, true);
    this.draw();
  }

  get size() {
    const width = this.view.picture.clientWidth, { rows, columns } = this.view.about;
    return [width, Math.round(width * Math.min(rows / columns, 1.3))];
  }

  get scale() { return (0.46 * Math.min(...this.size) * this.zoom) / this.radius; }

  draw() {
    if (!this.program) return;
    const gl = this.gl, [width, height] = this.size, ratio = window.devicePixelRatio || 1;
    this.canvas.width = width * ratio; this.canvas.height = height * ratio;
    this.canvas.style.height = `${height}px`;
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.clearColor(0.125, 0.14, 0.17, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const at = (name) => gl.getUniformLocation(this.program, name), scale = this.scale, m = this.turn;
    gl.uniformMatrix3fv(at("turn"), false, [m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]]);
    gl.uniform3f(at("middle"), 0, 0, 0);
    gl.uniform2f(at("pan"), (2 * this.pan[0]) / width, (-2 * this.pan[1]) / height);
    gl.uniform3f(at("stretch"), (2 * scale) / width, (2 * scale) / height, 0.25 / this.radius);
    gl.uniform1f(at("times"), this.times);
    gl.drawElements(gl.TRIANGLES, this.triangles.length, gl.UNSIGNED_INT, 0);
    this.marks.forEach((mark, k) => {
      const tip = applied(m, [0, 1, 2].map((axis) => (axis === k ? 1 : 0)));
      mark.style.left = `${34 + 24 * tip[0]}px`; mark.style.top = `${height - 34 - 24 * tip[1]}px`;
      mark.style.opacity = String(0.65 + 0.35 * tip[2]);
    });
  }

  rotate(right, down) {
    this.turn = product(about("y", right), this.turn);
    this.turn = product(about("x", down), this.turn);
    this.draw();
  }

  shift(dx, dy) { this.pan = [this.pan[0] + dx, this.pan[1] + dy]; this.draw(); }

  zoomBy(factor) { this.zoom = Math.min(Math.max(this.zoom * factor, 0.2), 64); this.draw(); }

  reset() { this.zoom = 1; this.pan = [0, 0]; this.turn = this.camera; this.draw(); }

  // Reads the sample that is drawn nearest to a place of the screen.
  touch(x, y) {
    if (!this.program) return;
    const [width, height] = this.size, scale = this.scale, m = this.turn, [X, Y, Z] = this.position;
    let best = -1, front = -Infinity;
    for (let i = 0; i < X.length; i++) {
      if (X[i] !== X[i]) continue;
      const p = [X[i] - this.middle[0], Y[i] - this.middle[1], Z[i] - this.middle[2]];
      if (this.movement && this.times) for (let k = 0; k < 3; k++) p[k] += this.times * (this.movement[k][i] || 0);
      const right = width / 2 + this.pan[0] + scale * (m[0] * p[0] + m[1] * p[1] + m[2] * p[2]) - x;
      const below = height / 2 + this.pan[1] - scale * (m[3] * p[0] + m[4] * p[1] + m[5] * p[2]) - y;
      const away = right * right + below * below;
      if (away > NEAR_PX * NEAR_PX) continue;
      // Nearest in the picture, but for what lies clearly behind.
      const depth = scale * (m[6] * p[0] + m[7] * p[1] + m[8] * p[2]) - 4 * Math.sqrt(away);
      if (depth > front) { front = depth; best = i; }
    }
    const columns = this.view.fields.columns;
    if (best >= 0) this.view.point({ row: Math.floor(best / columns), column: best % columns });
  }

  close() {
    this.watch.disconnect();
    this.canvas.remove();
    for (const mark of this.marks) mark.remove();
    if (this.bar) this.bar.remove();
    // Browsers keep a dozen of them at most.
    this.gl.getExtension("WEBGL_lose_context")?.loseContext();
    this.view.space = null;
    this.view.canvas.hidden = false;
    this.view.turn.setAttribute("aria-pressed", "false");
    this.view.paint();
  }
}
