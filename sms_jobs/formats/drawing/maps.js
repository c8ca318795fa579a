// A map of a view: a field in colours, with zoom, a range of colours, and the values under the pointer.

const PALETTES = Object.fromEntries(Object.entries(COLOUR_MAPS).map(([name, text]) => {
  const palette = new Uint8Array(text.length / 2);
  for (let i = 0; i < palette.length; i++) palette[i] = parseInt(text.substr(2 * i, 2), 16);
  return [name, palette];
}));
const MISSING = [191, 191, 191];
const LARGEST_ZOOM = 64;

function paletteOf(name) { return PALETTES[name] || PALETTES.viridis; }

class View {
  // `later`: it is built when it is first shown.
  constructor(section, source, later = false) {
    this.section = section;
    this.about = JSON.parse(section.querySelector("script.about").textContent);
    this.fields = new Fields(this.about, source);
    this.chosen = 0;
    this.ofSigma = false;
    this.limits = null;
    this.colours = null;
    this.zoom = 1;
    this.centre = [this.about.columns / 2 - 0.5, this.about.rows / 2 - 0.5];
    this.cursor = null;
    this.space = null;
    this.drawn = Promise.resolve();
    if (!later) this.build();
  }

  get field() { return this.about.fields[this.chosen]; }
  get part() { return this.ofSigma && this.field.sigma ? this.field.sigma : this.field; }
  // The range of colours: what was asked for, else the field's own; blue and red meet at zero.
  get shown() {
    const [low, high] = this.limits || this.part.limits;
    if (this.limits || this.colours !== "bluered" || low >= 0 || high <= 0) return [low, high];
    return [-Math.max(-low, high), Math.max(-low, high)];
  }
  get palette() {
    if (this.field.categories) return paletteOf("groups");
    return paletteOf(this.colours || (this.field.unit === "count" && !this.ofSigma ? "grey" : "viridis"));
  }

  build() {
    const id = this.section.id;
    const options = this.about.fields.map((field, place) =>
      made("option", { value: place }, field.unit ? `${field.name} [${field.unit}]` : field.name));
    this.select = made("select", { id: `${id}-field`, onchange: () => this.choose(Number(this.select.value)) },
      ...options);
    this.spread = made("button", { type: "button", "aria-pressed": "false",
      title: "show the standard deviation of the field", onclick: () => this.show(!this.ofSigma) }, "± sigma");
    this.low = this.limit("from");
    this.high = this.limit("to");
    this.scheme = made("select", { "aria-label": "colours", onchange: () => {
      this.colours = this.scheme.value || null; this.refresh(); } },
      made("option", { value: "" }, "usual"), made("option", { value: "viridis" }, "viridis"),
      made("option", { value: "bluered" }, "blue-red"), made("option", { value: "grey" }, "grey"));
    const button = (label, title, action) =>
      made("button", { type: "button", title, "aria-label": title, onclick: action }, label);
    this.turn = made("button", { type: "button", "aria-pressed": "false",
      title: "turn the surface in space", onclick: () => this.toggleSpace() }, "3D");
    if (!this.about.position) this.turn.hidden = true;
    this.canvas = made("canvas", { tabindex: 0, role: "application", "aria-describedby": `${id}-read` });
    this.picture = made("div", { class: "picture" }, this.canvas);
    this.scale = made("canvas", { class: "scale", role: "img" });
    this.legend = made("ul", { class: "legend", hidden: true });
    this.read = made("p", { class: "readout", id: `${id}-read`, "aria-live": "polite" });
    this.path = made("div", { class: "followed" });
    this.live = made("div", { class: "live" },
      made("div", { class: "controls" },
        made("label", {}, "field ", this.select), this.spread, this.turn,
        button("−", "zoom out", () => this.zoomBy(1 / 1.6)), button("+", "zoom in", () => this.zoomBy(1.6)),
        button("whole", "show the whole picture", () => this.whole())),
      made("details", { class: "more" }, made("summary", {}, "colours and range"), made("div", { class: "controls" },
        made("label", {}, "from ", this.low), made("label", {}, "to ", this.high),
        button("own range", "colours over this map's own range", () => this.range(null)),
        button("range of all states", "colours over the range of this field in all states", () => this.common()),
        made("label", {}, "colours ", this.scheme),
        button("all maps like this", "show this field, range and colours in all maps", () => this.spreadOut()))),
      this.picture, this.scale, this.legend, this.read, this.path);
    this.section.querySelector(".stills").after(this.live);
    this.listen();
  }

  limit(words) {
    return made("input", { type: "number", step: "any", "aria-label": `colours ${words}`, onchange: () => {
      const low = Number(this.low.value), high = Number(this.high.value);
      if (Number.isFinite(low) && Number.isFinite(high) && low < high) this.range([low, high]);
      else this.refresh();
    } });
  }

  listen() {
    new Pointing(this.canvas, {
      move: (x, y) => this.point(this.sampleAt(x, y)),
      leave: () => {},
      drag: (dx, dy) => this.pan(dx, dy),
      click: (x, y) => this.pick(this.sampleAt(x, y)),
      zoom: (factor, x, y) => this.zoomBy(factor, x, y),
      free: () => this.zoom > 1,
    });
    this.canvas.addEventListener("keydown", (event) => this.key(event));
    new ResizeObserver(() => this.paint()).observe(this.picture);
  }

  key(event) {
    const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    if (steps[event.key]) {
      const [dx, dy] = steps[event.key].map((d) => d * (event.shiftKey ? 10 : 1));
      const at = this.cursor || { row: this.fields.rows >> 1, column: this.fields.columns >> 1 };
      this.point({ row: at.row + dy, column: at.column + dx });
    } else if (event.key === "+" || event.key === "=") this.zoomBy(1.6);
    else if (event.key === "-") this.zoomBy(1 / 1.6);
    else if (event.key === "0") this.whole();
    else if (event.key === "Enter") { if (this.cursor) this.pick(this.cursor); }
    else return;
    event.preventDefault();
  }

  choose(place) { this.chosen = place; this.limits = null; return this.refresh(); }

  show(ofSigma) { this.ofSigma = ofSigma; this.limits = null; return this.refresh(); }

  range(limits) { this.limits = limits; return this.refresh(); }

  // One range for this field in every state, so that colours can be compared.
  common() {
    const all = views.map((view) => view.fields.named(this.field.name)).filter(Boolean)
      .map((field) => (this.ofSigma && field.sigma ? field.sigma : field).limits);
    return this.range([Math.min(...all.map((l) => l[0])), Math.max(...all.map((l) => l[1]))]);
  }

  spreadOut() {
    const limits = this.shown;
    for (const view of views) {
      if (view === this || !view.imitate(this)) continue;
      view.limits = limits;
      // Others are drawn when they come into sight.
      if (view.values) view.refresh();
    }
  }

  // Takes the field, the range and the colours of another map; false if it has no such field.
  imitate(other) {
    const place = this.about.fields.findIndex((field) => field.name === other.field.name);
    if (place < 0) return false;
    this.chosen = place; this.ofSigma = other.ofSigma; this.colours = other.colours; this.limits = other.limits;
    return true;
  }

  // Lets go of all that was unpacked and drawn.
  rest() {
    if (this.space) closeSpace();
    this.resting = true;
    this.fields.forget();
    this.values = this.sigma = this.image = null;
    if (this.live) this.canvas.width = this.canvas.height = 0;
  }

  // Unpack what is to be shown, then draw it.
  refresh() {
    if (!this.live) this.build();
    this.resting = false;
    this.drawn = this.renew();
    return this.drawn;
  }

  async renew() {
    const field = this.field;
    this.select.value = String(this.chosen);
    await this.fields.described(field);
    if (this.field !== field) return;
    const part = this.part;
    this.spread.disabled = !field.sigma;
    this.spread.setAttribute("aria-pressed", String(part !== field));
    const limits = this.shown;
    this.low.value = written(limits[0]); this.high.value = written(limits[1]);
    for (const control of [this.low, this.high, this.scheme]) control.disabled = Boolean(field.categories);
    this.scheme.value = this.colours || "";
    const values = await (part === field ? this.fields.values(field) : this.fields.sigma(field));
    const sigma = await this.fields.sigma(field), behind = await this.behind();
    if (this.resting || this.field !== field || this.part !== part) return;
    this.values = values; this.sigma = sigma;
    this.image = this.coloured(values, limits, behind);
    this.canvas.setAttribute("aria-label", `Map of ${field.name}, ${this.about.title}, state ${this.about.state}. ` +
      "Arrow keys move the point whose values are read; plus and minus zoom; Enter follows the point over the states.");
    this.paintScale(limits);
    this.paint();
    if (this.space) this.space.colour();
    if (this.cursor) this.point(this.cursor); else this.hint();
  }

  hint() {
    const step = this.fields.step;
    const nth = { 2: "2nd", 3: "3rd" }[step] || `${step}th`;
    const apart = this.about.pitchMm ? `, ${this.about.pitchMm.toPrecision(3)} mm apart` : "";
    const sampled = step > 1 ? `Every ${nth} pixel of ${this.about.columns} x ${this.about.rows}${apart}. ` : "";
    this.read.textContent = `${sampled}Point at the map to read values; click to follow a point over the states. ` +
      "Once the map is clicked, the wheel zooms and dragging moves it.";
  }

  // What was seen in a flat image at rest, as greys: it is shown where a field has no value.
  async behind() {
    if (this.about.position || this.field.unit === "count" || this.field.categories) return null;
    const other = views.find((view) => view.about.key === this.about.key && view.fields.named("texture"));
    if (!other) return null;
    const texture = other.fields.named("texture"), levels = await other.fields.values(texture), { limits } = texture;
    return levels.map((level) => 255 * Math.min(Math.max((level - limits[0]) / (limits[1] - limits[0]), 0), 1));
  }

  coloured(values, limits, behind) {
    const canvas = document.createElement("canvas");
    canvas.width = this.fields.columns; canvas.height = this.fields.rows;
    const context = canvas.getContext("2d");
    const pixels = context.createImageData(canvas.width, canvas.height);
    for (let i = 0; i < values.length; i++) {
      const seen = behind && !(values[i] === values[i]) ? behind[i] : NaN;
      const [r, g, b] = seen === seen ? [seen, seen, seen] : this.colour(values[i], limits);
      pixels.data.set([r, g, b, 255], 4 * i);
    }
    context.putImageData(pixels, 0, 0);
    return canvas;
  }

  colour(value, limits) {
    if (!(value === value)) return MISSING;
    const palette = this.palette, last = palette.length / 3 - 1;
    const place = this.field.categories ? Math.min(this.field.groups[value], last)
      : Math.round(Math.min(Math.max((value - limits[0]) / (limits[1] - limits[0]), 0), 1) * last);
    return [palette[3 * place], palette[3 * place + 1], palette[3 * place + 2]];
  }

  // Screen: a canvas of `width` CSS pixels shows the whole image at zoom 1.
  get screen() {
    const width = this.picture.clientWidth, { rows, columns } = this.about;
    // A tall image is seen as a whole: no higher than the window.
    const height = Math.min(width * Math.min(rows / columns, 1.3), Math.max(320, 0.85 * window.innerHeight));
    return { width, height: Math.round(height), ratio: window.devicePixelRatio || 1 };
  }

  get pitch() {
    const { width, height } = this.screen;
    return Math.min(width / this.about.columns, height / this.about.rows) * this.zoom;
  }

  paint() {
    const { width, height, ratio } = this.screen;
    if (!this.image || !width || this.space) return;
    this.canvas.width = width * ratio; this.canvas.height = height * ratio;
    this.canvas.style.height = `${height}px`;
    this.canvas.style.touchAction = this.zoom > 1 ? "none" : "pan-y";
    const context = this.canvas.getContext("2d");
    context.scale(ratio, ratio);
    context.imageSmoothingEnabled = false;
    const [left, top] = this.toScreen(this.fields.left - 0.5, this.fields.top - 0.5), size = this.pitch * this.fields.step;
    context.drawImage(this.image, left, top, size * this.fields.columns, size * this.fields.rows);
    this.paintOver(context);
    if (this.cursor) {
      const [x, y] = this.toScreen(...this.pixelOf(this.cursor));
      for (const [colour, line] of [["#ffffff", 4], ["#d0021b", 2]]) {
        context.strokeStyle = colour; context.lineWidth = line; context.beginPath();
        context.moveTo(x - 9, y); context.lineTo(x - 3, y); context.moveTo(x + 3, y); context.lineTo(x + 9, y);
        context.moveTo(x, y - 9); context.lineTo(x, y - 3); context.moveTo(x, y + 3); context.lineTo(x, y + 9);
        context.stroke();
      }
    }
  }

  toScreen(x, y) {
    const { width, height } = this.screen, pitch = this.pitch;
    return [width / 2 + (x - this.centre[0]) * pitch, height / 2 + (y - this.centre[1]) * pitch];
  }

  toPixel(x, y) {
    const { width, height } = this.screen, pitch = this.pitch;
    return [this.centre[0] + (x - width / 2) / pitch, this.centre[1] + (y - height / 2) / pitch];
  }

  sampleAt(x, y) {
    const { left, top, step } = this.fields, [column, row] = this.toPixel(x, y);
    return { row: Math.floor((row + 0.5 - top) / step), column: Math.floor((column + 0.5 - left) / step) };
  }

  pixelOf({ row, column }) {
    const { left, top, step, half } = this.fields;
    return [left + column * step + half, top + row * step + half];
  }

  zoomBy(factor, x, y) {
    if (this.space) { this.space.zoomBy(factor); return; }
    const { width, height } = this.screen, before = this.toPixel(x ?? width / 2, y ?? height / 2);
    this.zoom = Math.min(Math.max(this.zoom * factor, 1), LARGEST_ZOOM);
    const after = this.toPixel(x ?? width / 2, y ?? height / 2);
    this.centre = this.centre.map((c, i) => c + before[i] - after[i]);
    this.pan(0, 0);
  }

  pan(dx, dy) {
    const pitch = this.pitch, sizes = [this.about.columns, this.about.rows], { width, height } = this.screen;
    this.centre = [this.centre[0] - dx / pitch, this.centre[1] - dy / pitch].map((c, i) => {
      const half = 0.5 * [width, height][i] / pitch, size = sizes[i];
      return 2 * half >= size ? size / 2 - 0.5 : Math.min(Math.max(c, half - 0.5), size - half - 0.5);
    });
    this.paint();
  }

  whole() {
    if (this.space) { this.space.reset(); return; }
    this.zoom = 1;
    this.pan(0, 0);
  }

  // What is drawn over the map, by whoever has something to draw.
  paintOver() {}

  // Read all that is known at a sample.
  async point(sample) {
    const row = Math.min(Math.max(sample.row, 0), this.fields.rows - 1);
    const column = Math.min(Math.max(sample.column, 0), this.fields.columns - 1);
    this.cursor = { row, column };
    this.paint();
    const field = this.field, place = row * this.fields.columns + column, [x, y] = this.pixelOf(this.cursor);
    const value = (await this.fields.values(field))[place];
    const sigma = ((await this.fields.sigma(field)) || [])[place];
    const position = await this.fields.vectors(this.about.position);
    const pieces = [made("b", {}, this.inWords(field, value, sigma))];
    if (!field.categories && !(value === value)) pieces.push(` (${await this.status(place)})`);
    pieces.push(` at x ${x}, y ${y} px`);
    if (position && position[0][place] === position[0][place])
      pieces.push(`; X ${position[0][place].toFixed(3)}, Y ${position[1][place].toFixed(3)}, Z ${position[2][place].toFixed(3)} mm`);
    else if (this.about.mmPerPx)
      pieces.push(`; ${(x * this.about.mmPerPx).toFixed(3)}, ${(y * this.about.mmPerPx).toFixed(3)} mm`);
    if (!field.categories && value === value && field.step)
      pieces.push(`; in steps of ${Number(field.step.toPrecision(2))}${field.unit ? ` ${field.unit}` : ""}`);
    if (this.cursor.row === row && this.cursor.column === column && this.field === field)
      this.read.replaceChildren(...pieces);
  }

  inWords(field, value, sigma) {
    if (field.categories) return `${field.name}: ${field.categories[value] ?? "no value"}`;
    const unit = field.unit ? ` ${field.unit}` : "";
    if (!(value === value)) return `${field.name}: no value`;
    return sigma === sigma && sigma !== undefined
      ? `${field.name}: ${written(value, sigma)} ± ${written(sigma, sigma)}${unit}`
      : `${field.name}: ${written(value)}${unit}`;
  }

  async status(place) {
    const found = [];
    for (const field of this.about.fields.filter((f) => f.categories)) {
      const words = field.categories[(await this.fields.values(field))[place]];
      if (words && words !== "valid") found.push(`${field.name}: ${words}`);
    }
    return found.join("; ") || "nothing is known here";
  }

  paintScale(limits) {
    const field = this.field;
    this.scale.hidden = Boolean(field.categories); this.legend.hidden = !field.categories;
    if (field.categories) {
      const present = field.names.filter((_, group) => field.groups.includes(group));
      this.legend.replaceChildren(...present.map((words) => {
        const swatch = made("span", { class: "swatch" });
        swatch.style.background = `rgb(${this.colour(field.groups.indexOf(field.names.indexOf(words)), limits).join()})`;
        return made("li", {}, swatch, words);
      }));
      return;
    }
    const width = this.picture.clientWidth || 300, ratio = window.devicePixelRatio || 1, height = 48;
    this.scale.style.height = `${height}px`;
    this.scale.width = width * ratio; this.scale.height = height * ratio;
    const context = this.scale.getContext("2d"), ink = getComputedStyle(document.body).color;
    context.scale(ratio, ratio);
    for (let x = 0; x < width; x++) {
      context.fillStyle = `rgb(${this.colour(limits[0] + (x / (width - 1)) * (limits[1] - limits[0]), limits).join()})`;
      context.fillRect(x, 0, 1.5, 14);
    }
    context.fillStyle = ink; context.strokeStyle = ink; context.font = "12px system-ui, sans-serif";
    const marks = ticks(limits[0], limits[1], 6);
    for (const value of marks) {
      const x = ((value - limits[0]) / (limits[1] - limits[0])) * width;
      context.fillRect(Math.min(x, width - 1), 14, 1, 4);
      const label = String(Number(value.toPrecision(8)));
      const room = context.measureText(label).width / 2;
      context.fillText(label, Math.min(Math.max(x - room, 0), width - 2 * room), 30);
    }
    const name = this.part === field ? field.name : `standard deviation of ${field.name}`;
    const unit = field.unit ? ` [${field.unit}]` : "";
    context.textAlign = "center"; context.fillText(`${name}${unit}`, width / 2, 44);
    this.scale.setAttribute("aria-label",
      `Colours of ${name} from ${written(limits[0])} to ${written(limits[1])} ${field.unit}`);
  }

  // A place was chosen: it is followed over the states.
  pick(sample) { this.point(sample); followPoint(this, this.cursor); }

  toggleSpace() { if (this.space) closeSpace(); else openSpace(this); }
}

// Mouse, pen and fingers on a canvas: pointing, dragging, pinching, the wheel once it has the focus.
class Pointing {
  constructor(canvas, actions) {
    this.canvas = canvas; this.actions = actions; this.down = new Map(); this.moved = false; this.apart = 0;
    canvas.addEventListener("pointerdown", (event) => this.begin(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => this.end(event));
    canvas.addEventListener("wheel", (event) => {
      if (document.activeElement !== canvas && !event.ctrlKey) return;
      event.preventDefault();
      actions.zoom(Math.exp(-event.deltaY / 400), event.offsetX, event.offsetY);
    }, { passive: false });
    canvas.addEventListener("contextmenu", (event) => { if (this.moved) event.preventDefault(); });
  }

  begin(event) {
    this.down.set(event.pointerId, event); this.moved = false; this.apart = 0;
    if (this.actions.free()) this.canvas.setPointerCapture(event.pointerId);
  }

  move(event) {
    const before = this.down.get(event.pointerId);
    if (!before) { this.actions.move(event.offsetX, event.offsetY); return; }
    this.down.set(event.pointerId, event);
    const dx = event.clientX - before.clientX, dy = event.clientY - before.clientY;
    if (Math.hypot(dx, dy) > 2) this.moved = true;
    if (this.down.size === 2) {
      const [a, b] = [...this.down.values()], apart = Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
      if (this.apart) this.actions.zoom(apart / this.apart, (a.offsetX + b.offsetX) / 2, (a.offsetY + b.offsetY) / 2);
      this.apart = apart;
    } else if (dx || dy) this.actions.drag(dx, dy, event);
  }

  end(event) {
    const begun = this.down.get(event.pointerId);
    this.down.delete(event.pointerId); this.apart = 0;
    if (begun && !this.moved && event.type === "pointerup" && event.button === 0)
      this.actions.click(event.offsetX, event.offsetY);
  }
}
