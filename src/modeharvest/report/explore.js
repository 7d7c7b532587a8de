// Fields on a page, to be zoomed, read, blinked and saved. Plain JavaScript without a library; the
// page's static pictures are there without it. Numbers lie in #explore-data as explore.py packed
// them: quantised to 16 bits, predicted from their neighbours, deflated. What is drawn, read at the
// pointer and saved are the same samples: the nearest one, nothing is interpolated.
"use strict";
(() => {
  const source = document.getElementById("explore-data");
  if (!source || typeof DecompressionStream === "undefined") return;
  const data = JSON.parse(source.textContent);
  const root = document.getElementById("explore");
  const { rows, cols, factor: every, pixel, x0, y0 } = data;
  const h = every * pixel, samples = rows * cols;
  const MINUS = "\u2212";
  const $ = (selector, within = root) => within.querySelector(selector);
  const $$ = (selector, within = root) => [...within.querySelectorAll(selector)];

  // --- numbers ---------------------------------------------------------------------------------

  const bytesOf = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const inflated = async (text) => {
    const stream = new Blob([bytesOf(text)]).stream().pipeThrough(new DecompressionStream("deflate"));
    return new Uint8Array(await new Response(stream).arrayBuffer());
  };

  /** What a function makes of a key, once for each. */
  const remembered = (make) => {
    const known = new Map();
    return (key) => known.get(key) ?? known.set(key, make(key)).get(key);
  };

  const mask = remembered(async (k) => {
    const bits = await inflated(data.masks[k]);
    return (i) => (bits[i >> 3] >> (i & 7)) & 1;
  });

  /** Levels of a packed array as numbers; of pixels without a value those of the nearest with. */
  const unpacked = remembered(async (k) => {
    const { low, step, predicted, data: text } = data.packed[k];
    const bytes = await inflated(text), n = bytes.length / 2;
    const across = n === samples ? cols : n / 2, values = new Float64Array(n);
    const levels = new Uint16Array(n);
    for (let i = 0; i < n; i++) {
      const coded = bytes[i] | (bytes[n + i] << 8);
      if (!predicted) levels[i] = coded;
      else {
        const col = i % across;
        const left = col ? levels[i - 1] : 0;
        const upper = i >= across ? levels[i - across] : 0;
        const corner = col && i >= across ? levels[i - across - 1] : 0;
        levels[i] = left + upper - corner + ((coded >>> 1) ^ -(coded & 1));
      }
      values[i] = low + step * levels[i];
    }
    return values;
  });

  /** A quantity of a state: its values, where they are known, and how finely they are stored. */
  const field = async (state, terms) => {
    const have = data.states[state].arrays;
    if (!terms.length || !terms.every((sum) => Object.keys(sum).every((name) => name in have))) {
      return null;
    }
    const values = new Float64Array(samples), known = new Uint8Array(samples).fill(1);
    const masks = new Set();
    let variance = 0;
    for (const sum of terms) {
      const total = new Float64Array(samples);
      for (const [name, factor] of Object.entries(sum)) {
        const packed = data.packed[have[name]], array = await unpacked(have[name]);
        variance += packed.step ** 2;
        for (let i = 0; i < samples; i++) total[i] += factor * array[i];
        if (packed.mask >= 0 && !masks.has(packed.mask)) {
          masks.add(packed.mask);
          const there = await mask(packed.mask);
          for (let i = 0; i < samples; i++) known[i] &= there(i);
        }
      }
      if (terms.length === 1) values.set(total);
      else for (let i = 0; i < samples; i++) values[i] += total[i] ** 2;
    }
    if (terms.length > 1) for (let i = 0; i < samples; i++) values[i] = Math.sqrt(values[i]);
    const where = [...masks].sort().join(","), drawn = wide.get(where) ?? grown(known);
    wide.set(where, drawn);
    return { values, known, drawn, where, step: Math.sqrt(variance) };
  };
  const fieldOf = remembered((key) => {
    const [state, quantity, which] = key.split(":").map(Number);
    return field(state, data.quantities[quantity][which ? "truth" : "terms"]);
  });

  const wide = new Map(); // by the masks' numbers

  /** Where a value is known or beside one that is: cells that the boundary may cut. */
  const grown = (known) => {
    const found = new Uint8Array(samples);
    for (let r = 0; r < rows; r++) for (let c = 0; c < cols; c++) {
      if (!known[r * cols + c]) continue;
      for (let a = Math.max(0, r - 1); a <= Math.min(rows - 1, r + 1); a++)
        for (let b = Math.max(0, c - 1); b <= Math.min(cols - 1, c + 1); b++) found[a * cols + b] = 1;
    }
    return found;
  };

  // --- shapes ----------------------------------------------------------------------------------

  const hasMotion = data.states.some((s) => "ux" in s.arrays && "uy" in s.arrays);

  /** Displacements of a state at samples and at the corners between them, u then v. */
  const motion = remembered(async (state) => {
    const { arrays } = data.states[state];
    if (!("ux" in arrays && "uy" in arrays)) return null;
    const at = [await unpacked(arrays.ux), await unpacked(arrays.uy)];
    const corners = at.map((u) => {
      const mean = new Float32Array((rows + 1) * (cols + 1));
      for (let r = 0; r <= rows; r++) for (let c = 0; c <= cols; c++) {
        const a = Math.max(0, r - 1), b = Math.min(rows - 1, r);
        const p = Math.max(0, c - 1), q = Math.min(cols - 1, c);
        mean[r * (cols + 1) + c] =
          (u[a * cols + p] + u[a * cols + q] + u[b * cols + p] + u[b * cols + q]) / 4;
      }
      return mean;
    });
    return { at, corners };
  });

  /** The material's boundary as pieces of SVG's path language [mm, y up]. */
  const boundary = remembered(async (key) => {
    const [state, scale] = key.split(":").map(Number);
    const X = await unpacked(data.boundary), m = X.length / 2;
    const own = data.states[state].boundary;
    const u = own === null || !scale ? null : await unpacked(own);
    const at = (i, d) => X[d * m + i] + (u ? scale * u[d * m + i] : 0);
    const pieces = [];
    let first = 0;
    for (const sides of data.loops) {
      const point = (k) => [0, 1].map((d) => at(first + (k % (2 * sides)), d));
      const write = (p) => p.map((value) => value.toFixed(4)).join(" ");
      pieces.push(`M${write(point(0))}`);
      for (let k = 0; k < sides; k++) {
        const [a, middle, b] = [point(2 * k), point(2 * k + 1), point(2 * k + 2)];
        const straight = Math.hypot(middle[0] - a[0], middle[1] - a[1]) < 1e-9;
        pieces.push(straight ? `L${write(b)}`
          : `Q${write(middle.map((value, d) => 2 * value - (a[d] + b[d]) / 2))} ${write(b)}`);
      }
      pieces.push("Z");
      first += 2 * sides;
    }
    return pieces.join("");
  });
  const pathOf = remembered(async (key) => new Path2D(await boundary(key)));

  // --- what all panels share -------------------------------------------------------------------

  const shared = {
    state: data.kind === "scores" ? 0 : data.states.length - 1, shape: 0, truth: false, unit: 0,
    zoom: 1, x: 0, y: 0, at: null, fixed: false,
  };
  let panels = [];
  let indices = new Map(); // which sample every pixel shows, of what was drawn last
  let box = null; // [left, right, bottom, top] of everything that can be shown, mm

  const units = data.unit === "mm"
    ? [["µm", 1e3], ["mm", 1], ["px", 1 / pixel]] : [[data.unit, 1]];
  const unitOf = (quantity) => quantity.unit === "length" ? units[shared.unit] : [quantity.unit, 1];

  const written = (value, digits = 4) => {
    if (!Number.isFinite(value)) return "–";
    const size = Math.abs(value);
    const text = size !== 0 && (size < 1e-3 || size >= 1e6)
      ? value.toExponential(digits - 1) : String(Number(value.toPrecision(digits)));
    return text.replace(/-/g, MINUS);
  };
  const read = (text) => Number(text.trim().replace(/\u2212/g, "-").replace(",", "."));

  const extent = async () => {
    const reach = [Infinity, -Infinity, Infinity, -Infinity];
    const X = await unpacked(data.boundary), m = X.length / 2;
    const include = (u, scale) => {
      for (let d = 0; d < 2; d++) for (let i = 0; i < m; i++) {
        const value = X[d * m + i] + (u ? scale * u[d * m + i] : 0);
        reach[2 * d] = Math.min(reach[2 * d], value);
        reach[2 * d + 1] = Math.max(reach[2 * d + 1], value);
      }
    };
    include(null, 0);
    if (shared.shape) for (const { boundary: own } of data.states) {
      if (own !== null) include(await unpacked(own), shared.shape);
    }
    const margin = 0.03 * Math.max(reach[1] - reach[0], reach[3] - reach[2]);
    return reach.map((value, k) => value + (k % 2 ? margin : -margin));
  };

  /** Position of a sample as a state and a shape show it [mm]. */
  const placed = (i, u) => {
    const x = x0 + h * (i % cols), y = y0 - h * Math.floor(i / cols);
    return u ? [x + shared.shape * u.at[0][i], y + shared.shape * u.at[1][i]] : [x, y];
  };

  const setView = (zoom, x, y) => {
    shared.zoom = Math.min(60, Math.max(1, zoom));
    const spare = 1 - 1 / shared.zoom;
    const clamp = (value, low, high) => {
      const middle = (low + high) / 2, reach = spare * (high - low) / 2;
      return Math.min(middle + reach, Math.max(middle - reach, value));
    };
    shared.x = clamp(x, box[0], box[1]);
    shared.y = clamp(y, box[2], box[3]);
    return draw();
  };

  // --- a panel ---------------------------------------------------------------------------------

  const colours = Object.fromEntries(
    Object.entries(data.colours).map(([name, text]) => [name, bytesOf(text)]));
  const limits = data.quantities.map(() => null); // one's own, in the data's unit

  class Panel {
    constructor(number, quantity, own) {
      this.quantity = quantity;
      this.own = own;
      this.element = document.getElementById("ex-panel").content.firstElementChild.cloneNode(true);
      this.element.setAttribute("aria-label", `Panel ${number + 1}`);
      const find = (name) => $(name, this.element);
      [this.map, this.over, this.stage] = [find(".ex-map"), find(".ex-over"), find(".ex-stage")];
      [this.low, this.high] = [find(".ex-low"), find(".ex-high")];
      [this.tag, this.value, this.marker] = [find(".ex-tag"), find(".ex-value"), find(".ex-ramp i")];
      this.choice = find(".ex-quantity");
      for (const [k, q] of data.quantities.entries()) this.choice.add(new Option(q.title, k));
      this.ownState = find(".ex-own");
      this.ownState.add(new Option("slider", -1));
      for (const [k, s] of data.states.entries())
        this.ownState.add(new Option(s.label.split(" · ").pop(), k));
      this.ownState.hidden = data.states.length < 2;
      this.choice.value = quantity;
      this.ownState.value = own;
      this.choice.onchange = () => { this.show(Number(this.choice.value)); draw(); };
      this.ownState.onchange = () => { this.own = Number(this.ownState.value); draw(); };
      for (const input of [this.low, this.high]) input.onchange = () => this.readLimits();
      find(".ex-auto").onclick = () => this.setLimits(null);
      find(".ex-fit").onclick = () => this.fitLimits();
      for (const button of $$("[data-save]", this.element))
        button.onclick = () => this.save(button.dataset.save);
      listen(this);
    }

    get state() { return this.own < 0 ? shared.state : this.own; }
    get spec() { return data.quantities[this.quantity]; }
    get showsTruth() { return shared.truth && this.spec.truth.length > 0; }

    /** Ends of the colours, in the data's unit: one's own, else by percentiles of all states. */
    get ends() {
      const known = this.spec.ends.filter(Boolean);
      if (limits[this.quantity]) return limits[this.quantity];
      if (!known.length) return [0, 1];
      const low = Math.min(...known.map((e) => e[0])), high = Math.max(...known.map((e) => e[1]));
      if (this.spec.signed) {
        const end = Math.max(Math.abs(low), Math.abs(high)) || 1;
        return [-end, end];
      }
      return [0, high > 0 ? high : 1];
    }

    show(quantity) {
      [this.quantity, this.choice.value] = [quantity, quantity];
      this.refuse(false);
    }

    /** Whether what stands in the limits' inputs is refused; there it stays until it is corrected. */
    refuse(refused) {
      for (const input of [this.low, this.high]) input.setAttribute("aria-invalid", String(refused));
    }

    /** Give the colours these ends; null: those of all states. */
    setLimits(pair) {
      limits[this.quantity] = pair;
      this.refuse(false);
      draw();
    }

    readLimits() {
      const [, factor] = unitOf(this.spec), pair = [this.low, this.high].map((i) => read(i.value) / factor);
      if (pair.every(Number.isFinite) && pair[0] < pair[1]) return this.setLimits(pair);
      this.refuse(true);
      say("Limits have to be two numbers, the lower one first.");
    }

    fitLimits() {
      let [low, high] = [Infinity, -Infinity];
      const { values, known } = this.shown ?? { values: [], known: [] };
      for (const i of this.index ?? []) {
        if (i >= 0 && known[i]) { low = Math.min(low, values[i]); high = Math.max(high, values[i]); }
      }
      if (low < high) this.setLimits([low, high]);
    }

    /** Millimetres to device pixels: scale, and where the view's middle lies. */
    transform(width = this.map.width, height = this.map.height) {
      const fit = Math.min(width / (box[1] - box[0]), height / (box[3] - box[2]));
      return { s: fit * shared.zoom, cx: width / 2, cy: height / 2 };
    }

    toMm(px, py) {
      const { s, cx, cy } = this.transform();
      return [shared.x + (px - cx) / s, shared.y - (py - cy) / s];
    }

    /** What `indexed` finds, once for all panels that show alike. */
    sharedIndex(u, { drawn, where }) {
      const { width, height } = this.map, { zoom, x, y, shape } = shared;
      const key = [width, height, zoom, x, y, u ? `${shape}:${this.state}` : "", where].join();
      const found = indices.get(key) ?? this.indexed(u, drawn);
      if (indices.size > 7) indices = new Map();
      return indices.set(key, found).get(key);
    }

    /** Which sample every device pixel shows: its number, or -1. */
    indexed(u, drawn) {
      const { width: W, height: H } = this.map, { s, cx, cy } = this.transform();
      const index = new Int32Array(W * H).fill(-1);
      const left = cx - s * shared.x, top = cy + s * shared.y; // of the origin
      if (!u) {
        const col = Int32Array.from({ length: W }, (_, p) => Math.round(((p + 0.5 - left) / s - x0) / h));
        for (let q = 0; q < H; q++) {
          const r = Math.round((y0 - (top - q - 0.5) / s) / h);
          if (r < 0 || r >= rows) continue;
          for (let p = 0; p < W; p++) {
            const c = col[p];
            if (c >= 0 && c < cols && drawn[r * cols + c]) index[q * W + p] = r * cols + c;
          }
        }
        return index;
      }
      // A cell's deformed corners in device pixels, and two triangles of them.
      const [ux, uy] = u.corners, wide = cols + 1, scale = shared.shape;
      const far = 8 * h * s * Math.max(1, scale) + 8; // no cell's corners are farther apart
      const X = new Float32Array(wide * (rows + 1)), Y = new Float32Array(wide * (rows + 1));
      for (let r = 0, k = 0; r <= rows; r++) for (let c = 0; c <= cols; c++, k++) {
        X[k] = left + s * (x0 + h * (c - 0.5) + scale * ux[k]);
        Y[k] = top - s * (y0 - h * (r - 0.5) + scale * uy[k]);
      }
      const triangle = (a, b, c, i) => {
        const p0 = Math.max(0, Math.ceil(Math.min(X[a], X[b], X[c]) - 0.5));
        const p1 = Math.min(W - 1, Math.floor(Math.max(X[a], X[b], X[c]) - 0.5));
        const q0 = Math.max(0, Math.ceil(Math.min(Y[a], Y[b], Y[c]) - 0.5));
        const q1 = Math.min(H - 1, Math.floor(Math.max(Y[a], Y[b], Y[c]) - 0.5));
        if (p0 > p1 || q0 > q1) return;
        const area = (X[b] - X[a]) * (Y[c] - Y[a]) - (X[c] - X[a]) * (Y[b] - Y[a]);
        const turn = area < 0 ? -1 : 1;
        for (let q = q0; q <= q1; q++) for (let p = p0; p <= p1; p++) {
          const x = p + 0.5, y = q + 0.5;
          if (turn * ((X[b] - X[a]) * (y - Y[a]) - (x - X[a]) * (Y[b] - Y[a])) >= 0
            && turn * ((X[c] - X[b]) * (y - Y[b]) - (x - X[b]) * (Y[c] - Y[b])) >= 0
            && turn * ((X[a] - X[c]) * (y - Y[c]) - (x - X[c]) * (Y[a] - Y[c])) >= 0) index[q * W + p] = i;
        }
      };
      for (let r = 0; r < rows; r++) for (let c = 0; c < cols; c++) {
        const i = r * cols + c, k = r * wide + c;
        if (!drawn[i] || X[k] < -far || Y[k] < -far || X[k] > W + far || Y[k] > H + far) continue;
        triangle(k, k + 1, k + wide, i);
        triangle(k + 1, k + wide + 1, k + wide, i);
      }
      return index;
    }

    /** Draw the map; whoever draws later wins. */
    async draw() {
      const turn = this.turn = (this.turn ?? 0) + 1;
      const state = this.state;
      const shown = await fieldOf(`${state}:${this.quantity}:${this.showsTruth ? 1 : 0}`);
      const u = shared.shape ? await motion(state) : null;
      const path = await pathOf(`${state}:${shared.shape}`);
      if (turn !== this.turn) return;
      this.shown = shown;
      this.path = path;
      this.motion = u;
      this.fit();
      const context = this.map.getContext("2d"), { width: W, height: H } = this.map;
      context.setTransform(1, 0, 0, 1, 0, 0);
      context.clearRect(0, 0, W, H);
      if (shown) {
        this.index = this.sharedIndex(u, shown);
        paint(context, this.index, shown.values, this.ends, this.lut, (inner) => this.clip(inner));
      }
      this.stroke(context);
      this.labels();
      this.drawOver();
    }

    get lut() { return colours[this.spec.signed ? "SIGNED" : "SIZE"]; }

    clip(context) {
      this.inMm(context);
      context.clip(this.path, "evenodd");
      context.setTransform(1, 0, 0, 1, 0, 0);
    }

    inMm(context) {
      const { s, cx, cy } = this.transform();
      context.setTransform(s, 0, 0, -s, cx - s * shared.x, cy + s * shared.y);
    }

    stroke(context) {
      this.inMm(context);
      context.lineWidth = devicePixelRatio * 0.8 / this.transform().s;
      context.strokeStyle = "#70757d";
      context.stroke(this.path);
      context.setTransform(1, 0, 0, 1, 0, 0);
    }

    /** Give both canvases the size that they have on the page. */
    fit() {
      const width = this.stage.clientWidth;
      const most = Math.max(280, Math.min(680, 0.66 * innerHeight));
      const tall = Math.min(most, width * Math.max(0.4, (box[3] - box[2]) / (box[1] - box[0])));
      this.stage.style.height = `${Math.round(tall)}px`;
      for (const canvas of [this.map, this.over]) {
        const size = [width, Math.round(tall)].map((side) => Math.round(side * devicePixelRatio));
        if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
      }
    }

    labels() {
      const [unit, factor] = unitOf(this.spec), [low, high] = this.ends;
      for (const [input, end] of [[this.low, low], [this.high, high]]) {
        const typing = input === document.activeElement || input.getAttribute("aria-invalid") === "true";
        if (!typing) input.value = written(end * factor, 3);
      }
      const ramp = $(".ex-ramp canvas", this.element).getContext("2d"), image = ramp.createImageData(256, 1);
      image.data.set(this.lut);
      ramp.putImageData(image, 0, 0);
      const pair = data.quantities.some((q) => q.truth.length), none = pair && shared.truth && !this.showsTruth;
      this.tag.hidden = !pair || !(shared.truth || blinking);
      this.tag.className = `ex-tag ${none ? "none" : this.showsTruth ? "" : "measured"}`;
      this.tag.textContent = none ? "has no truth" : this.showsTruth ? "truth" : "measured";
      const which = this.showsTruth ? "truth" : "measured";
      this.over.setAttribute("aria-label", `${this.spec.title}, ${data.states[this.state].label}, ${which}`);
      $(".ex-unit", this.element).textContent = unit || "–";
      $(".ex-save", this.element).title = unit;
    }

    /** The cross, the scale bar, and the value where the cross is. */
    drawOver() {
      const context = this.over.getContext("2d"), { width: W, height: H } = this.over;
      const dpr = devicePixelRatio, ink = getComputedStyle(root).color, { s, cx, cy } = this.transform();
      context.clearRect(0, 0, W, H);
      const length = roundDown(0.28 * W / s);
      const text = `${written(length)} ${data.unit}`;
      context.font = `600 ${12 * dpr}px system-ui, sans-serif`;
      context.fillStyle = getComputedStyle(this.stage).backgroundColor;
      context.globalAlpha = 0.82;
      const wide = Math.max(length * s, context.measureText(text).width);
      context.beginPath();
      context.roundRect(8 * dpr, H - 34 * dpr, wide + 12 * dpr, 27 * dpr, 5 * dpr);
      context.fill();
      context.globalAlpha = 1;
      context.fillStyle = ink;
      context.fillRect(14 * dpr, H - 14 * dpr, length * s, 2 * dpr);
      context.fillText(text, 14 * dpr, H - 19 * dpr);
      const value = this.reading();
      const [unit, factor] = unitOf(this.spec);
      this.marker.hidden = !value;
      if (!value) { this.value.textContent = "–"; return; }
      const [low, high] = this.ends, share = (value.own - low) / (high - low);
      this.marker.style.left = `${100 * Math.min(1, Math.max(0, share))}%`;
      this.value.innerHTML = `<b>${written(value.own * factor)}</b> ${unit}`;
      if (this.spec.unit === "length" && data.unit === "mm" && units[shared.unit][0] !== "px")
        this.value.innerHTML += ` <span>${written(value.own / pixel)} px</span>`;
      const [x, y] = placed(shared.at, this.motion);
      const px = cx + s * (x - shared.x), py = cy - s * (y - shared.y), r = 7 * dpr;
      for (const [colour, width] of [["#ffffffd0", 4 * dpr], ["#16191d", 1.6 * dpr]]) {
        context.strokeStyle = colour;
        context.lineWidth = width;
        context.beginPath();
        context.arc(px, py, r, 0, 2 * Math.PI);
        for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
          context.moveTo(px + dx * r, py + dy * r);
          context.lineTo(px + 2 * dx * r, py + 2 * dy * r);
        }
        context.stroke();
      }
    }

    /** The value at the cross; null where there is none. */
    reading() {
      const i = shared.at;
      return i === null || !this.shown?.known[i] ? null : { own: this.shown.values[i] };
    }

    /** The sample under a position on the page; null off the material. */
    sampleAt(clientX, clientY) {
      const place = this.over.getBoundingClientRect(), { width: W, height: H } = this.map;
      const p = Math.floor((clientX - place.left) * W / place.width);
      const q = Math.floor((clientY - place.top) * H / place.height);
      const i = p >= 0 && q >= 0 && p < W && q < H ? this.index?.[q * W + p] ?? -1 : -1;
      return i >= 0 && this.shown?.known[i] ? i : null;
    }

    get fileName() {
      const truth = this.showsTruth ? "-truth" : "";
      return `${this.spec.key}-${data.states[this.state].name}${truth}`;
    }

    /** All samples with a value as lines of CSV. */
    csv() {
      const [unit, factor] = unitOf(this.spec), { values, known, step } = this.shown;
      const digits = Math.max(0, Math.ceil(-Math.log10(step * factor)) + 1);
      const what = `${this.spec.title}, ${data.states[this.state].label}, ${this.showsTruth ? "truth" : "measured"}`;
      const lines = [`# ${what}`, `x [${data.unit}],y [${data.unit}],row [px],column [px],${this.spec.key}${unit ? ` [${unit}]` : ""}`];
      for (let i = 0; i < samples; i++) if (known[i]) {
        const r = Math.floor(i / cols), c = i % cols;
        lines.push([(x0 + h * c).toFixed(5), (y0 - h * r).toFixed(5), data.first[0] + every * r,
          data.first[1] + every * c, (values[i] * factor).toFixed(Math.min(digits, 12))].join(","));
      }
      return `${lines.join("\n")}\n`;
    }

    /** The map as shown, with its colours and words, as SVG; the field itself is a picture in it. */
    async svg() {
      const { width: W, height: H } = this.map, [unit, factor] = unitOf(this.spec), [low, high] = this.ends;
      const plain = new OffscreenCanvas(W, H), context = plain.getContext("2d");
      paint(context, this.index, this.shown.values, this.ends, this.lut);
      const picture = await urlOf(await plain.convertToBlob());
      const ramp = new OffscreenCanvas(256, 1), strip = ramp.getContext("2d");
      strip.drawImage($(".ex-ramp canvas", this.element), 0, 0);
      const { s, cx, cy } = this.transform(), k = 480 / W, size = [480, H * k];
      const matrix = `matrix(${[s, 0, 0, -s, cx - s * shared.x, cy + s * shared.y].join(" ")})`;
      const path = await boundary(`${this.state}:${shared.shape}`), length = roundDown(0.28 * W / s);
      const title = `${this.spec.title}, ${data.states[this.state].label}${this.showsTruth ? ", truth" : ""}`;
      const bar = size[1] + 50;
      return `<${"svg"} xmlns="http://www.w3.org/2000/svg" viewBox="0 0 ${size[0]} ${size[1] + 84}" width="${size[0]}" height="${size[1] + 84}" font-family="sans-serif" font-size="13">
<title>${escaped(title)}</title><rect width="100%" height="100%" fill="#fff"/>
<text x="8" y="20" font-weight="bold">${escaped(title)}</text>
<g transform="translate(0 30) scale(${k})"><clipPath id="view"><rect width="${W}" height="${H}"/></clipPath><clipPath id="material"><path d="${path}" transform="${matrix}" clip-rule="evenodd"/></clipPath>
<g clip-path="${"url"}(#view)"><image width="${W}" height="${H}" href="${picture}" clip-path="${"url"}(#material)" image-rendering="pixelated"/><path d="${path}" transform="${matrix}" fill="none" stroke="#70757d" stroke-width="${0.8 / (k * s)}"/></g></g>
<path d="M8 ${size[1] + 24}h${length * s * k}" stroke="#000" stroke-width="2"/><text x="8" y="${size[1] + 18}">${written(length)} ${data.unit}</text>
<image x="8" y="${bar - 8}" width="464" height="12" preserveAspectRatio="none" href="${await urlOf(await ramp.convertToBlob())}"/>
<text x="8" y="${bar + 22}">${written(low * factor, 3)}</text><text x="240" y="${bar + 22}" text-anchor="middle">${escaped(unit)}</text><text x="472" y="${bar + 22}" text-anchor="end">${written(high * factor, 3)}</text>
</svg>
`;
    }

    async png() {
      const picture = new Image();
      picture.src = URL.createObjectURL(new Blob([await this.svg()], { type: "image/svg+xml" }));
      await picture.decode();
      const canvas = document.createElement("canvas");
      [canvas.width, canvas.height] = [3 * picture.width, 3 * picture.height];
      canvas.getContext("2d").drawImage(picture, 0, 0, canvas.width, canvas.height);
      return new Promise((done) => canvas.toBlob(done));
    }

    async save(kind) {
      if (!this.shown) { say("Nothing to save: this state has no such field."); return; }
      const blob = kind === "csv" ? new Blob([this.csv()], { type: "text/csv" })
        : kind === "svg" ? new Blob([await this.svg()], { type: "image/svg+xml" }) : await this.png();
      const link = document.createElement("a");
      link.href = URL.createObjectURL(blob);
      link.download = `${this.fileName}.${kind}`;
      link.click();
      say(`Saved ${link.download}.`);
    }
  }

  const escaped = (text) => text.replace(/[&<>"]/g, (c) => `&#${c.charCodeAt(0)};`);
  const urlOf = (blob) => new Promise((done) => {
    const reader = new FileReader();
    reader.onload = () => done(reader.result);
    reader.readAsDataURL(blob);
  });
  const roundDown = (length) => {
    const power = 10 ** Math.floor(Math.log10(length));
    return power * [5, 2, 1].find((step) => step * power <= length);
  };

  /** Colour pixels by the values of the samples that they show. */
  const paint = (context, index, values, [low, high], lut, clip = () => {}) => {
    const { width, height } = context.canvas, image = new ImageData(width, height);
    const pixels = new Uint32Array(image.data.buffer), table = new Uint32Array(256);
    for (let k = 0; k < 256; k++) {
      table[k] = 0xff000000 | (lut[4 * k + 2] << 16) | (lut[4 * k + 1] << 8) | lut[4 * k];
    }
    const scale = 256 / (high - low);
    for (let p = 0; p < index.length; p++) {
      const i = index[p];
      if (i >= 0) pixels[p] = table[Math.min(255, Math.max(0, Math.floor((values[i] - low) * scale)))];
    }
    const plain = new OffscreenCanvas(width, height);
    plain.getContext("2d").putImageData(image, 0, 0);
    context.save();
    clip(context);
    context.drawImage(plain, 0, 0);
    context.restore();
  };

  // --- pointer and keys ------------------------------------------------------------------------

  const say = (text) => { $("#ex-live").textContent = text; };

  const point = (i, aloud = false) => {
    shared.at = i;
    for (const panel of panels) panel.drawOver();
    const where = $("#ex-where");
    if (i === null) { where.textContent = ""; return; }
    const r = Math.floor(i / cols), c = i % cols;
    where.textContent = `x ${written(x0 + h * c)} ${data.unit}, y ${written(y0 - h * r)} ${data.unit} `
      + `in the reference · row ${data.first[0] + every * r}, column ${data.first[1] + every * c}`
      + (shared.fixed ? " · fixed: click or Enter lets go" : "");
    if (aloud) say([where.textContent, ...panels.map((p) => `${p.spec.title}: ${p.value.textContent}`)].join("; "));
  };

  const zoomAt = (panel, factor, clientX, clientY) => {
    const place = panel.over.getBoundingClientRect(), ratio = panel.map.width / place.width;
    const [x, y] = panel.toMm((clientX - place.left) * ratio, (clientY - place.top) * ratio);
    const zoom = Math.min(60, Math.max(1, shared.zoom * factor)), share = shared.zoom / zoom;
    setView(zoom, x + (shared.x - x) * share, y + (shared.y - y) * share);
  };

  const listen = (panel) => {
    const { over } = panel, touches = new Map();
    let moved = 0;
    over.addEventListener("pointerdown", (event) => {
      over.focus({ preventScroll: true });
      touches.set(event.pointerId, [event.clientX, event.clientY]);
      over.setPointerCapture(event.pointerId);
      moved = 0;
    });
    over.addEventListener("pointermove", (event) => {
      const before = touches.get(event.pointerId);
      if (!before) {
        if (!shared.fixed) point(panel.sampleAt(event.clientX, event.clientY));
        return;
      }
      const now = [event.clientX, event.clientY];
      const others = [...touches].filter(([id]) => id !== event.pointerId);
      touches.set(event.pointerId, now);
      moved += Math.hypot(now[0] - before[0], now[1] - before[1]);
      if (moved < 4) return;
      over.classList.add("dragging");
      if (others.length) {
        const other = others[0][1], apart = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]) || 1;
        zoomAt(panel, apart(now) / apart(before), (now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
      }
      // Of two fingers the point between them is dragged: it moves by half of what each does.
      const per = devicePixelRatio / panel.transform().s / (others.length ? 2 : 1);
      setView(shared.zoom, shared.x - (now[0] - before[0]) * per, shared.y + (now[1] - before[1]) * per);
    });
    const release = (event) => {
      if (touches.delete(event.pointerId) && event.type === "pointerup" && moved < 4) {
        const found = panel.sampleAt(event.clientX, event.clientY);
        shared.fixed = found !== null && (event.pointerType !== "mouse" || !shared.fixed);
        point(found, true);
      }
      over.classList.remove("dragging");
    };
    over.addEventListener("pointerup", release);
    over.addEventListener("pointercancel", release);
    over.addEventListener("pointerleave", () => { if (!shared.fixed) point(null); });
    over.addEventListener("dblclick", (event) => zoomAt(panel, 2, event.clientX, event.clientY));
    over.addEventListener("wheel", (event) => {
      if (document.activeElement !== over && !event.ctrlKey) return; // the page scrolls
      event.preventDefault();
      zoomAt(panel, Math.exp(-0.0016 * event.deltaY), event.clientX, event.clientY);
    }, { passive: false });
  };

  const ARROWS = { ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowUp: [-1, 0], ArrowDown: [1, 0] };
  /** Keys with a map in focus, or a button, which has arrows and Enter for itself. */
  const key = (event) => {
    const panel = panels.find(({ over }) => over === event.target);
    if (event.target.matches("select, input")) return;
    const arrow = panel && ARROWS[event.key];
    const step = { "+": "in", "=": "in", "-": "out", 0: "all", "[": "previous", "]": "next" }[event.key];
    if (event.altKey || event.metaKey || (event.ctrlKey && !arrow)) return; // the browser's own
    if (arrow && event.shiftKey) {
      const far = 0.15 * (box[1] - box[0]) / shared.zoom;
      setView(shared.zoom, shared.x + arrow[1] * far, shared.y - arrow[0] * far);
    } else if (arrow) {
      const far = event.ctrlKey ? 10 : 1, i = shared.at ?? middle(panel);
      const r = Math.min(rows - 1, Math.max(0, Math.floor(i / cols) + far * arrow[0]));
      const c = Math.min(cols - 1, Math.max(0, (i % cols) + far * arrow[1]));
      shared.fixed = true;
      point(r * cols + c, true);
    } else if (panel && event.key === "Enter") { shared.fixed = shared.at !== null && !shared.fixed; point(shared.at, true); }
    else if (event.key === "Escape") { shared.fixed = false; point(null); }
    else if (event.key === "b" || event.key === "B") acts[shared.truth ? "measured" : "truth"]();
    else if ((event.key === "d" || event.key === "D") && hasMotion) reshape(shared.shape ? 0 : 1);
    else if (step) acts[step]();
    else return;
    event.preventDefault();
  };

  /** A sample with a value near the middle of a panel's view. */
  const middle = (panel) => {
    const { width: W, height: H } = panel.map;
    let best = 0, least = Infinity;
    for (let p = 0; panel.shown && p < panel.index.length; p++) {
      const i = panel.index[p], away = (p % W - W / 2) ** 2 + (Math.floor(p / W) - H / 2) ** 2;
      if (i >= 0 && away < least && panel.shown.known[i]) [best, least] = [i, away];
    }
    return best;
  };

  // --- the bar above all panels ----------------------------------------------------------------

  let blinking = 0;
  const showTruth = (truth) => {
    shared.truth = truth;
    mark();
    draw();
  };
  const mark = () => {
    for (const [name, on] of [["measured", !shared.truth], ["truth", shared.truth], ["blink", blinking]])
      $(`[data-do="${name}"]`).setAttribute("aria-pressed", String(Boolean(on)));
  };
  const stopBlinking = () => { clearInterval(blinking); blinking = 0; };
  const acts = {
    measured: () => { stopBlinking(); showTruth(false); say("Measured"); },
    truth: () => { stopBlinking(); showTruth(true); say("Truth"); },
    blink: () => {
      if (blinking) { stopBlinking(); showTruth(shared.truth); return; }
      blinking = setInterval(() => showTruth(!shared.truth), 500);
      showTruth(!shared.truth);
      say("Blinking; press again to stop");
    },
    previous: () => setState(shared.state - 1),
    next: () => setState(shared.state + 1),
    in: () => setView(1.5 * shared.zoom, shared.x, shared.y),
    out: () => setView(shared.zoom / 1.5, shared.x, shared.y),
    all: () => setView(1, shared.x, shared.y),
  };
  const setState = (k) => {
    shared.state = Math.min(data.states.length - 1, Math.max(0, k));
    $("#ex-state").value = shared.state;
    $("#ex-state").setAttribute("aria-valuetext", data.states[shared.state].label);
    $("#ex-label").textContent = data.states[shared.state].label;
    draw();
  };
  const reshape = async (shape) => {
    shared.shape = shape;
    $("#ex-shape").value = shape;
    box = await extent();
    return setView(shared.zoom, shared.x, shared.y);
  };

  let asked = null;
  /** Draw all panels, once for all that was changed meanwhile. */
  const draw = () => asked ??= new Promise((done) => requestAnimationFrame(async () => {
    asked = null;
    await Promise.all(panels.map((panel) => panel.draw()));
    done();
  }));

  const arrange = (count) => {
    const holder = $("#ex-panels");
    holder.dataset.count = count;
    while (panels.length > count) panels.pop().element.remove();
    while (panels.length < count) {
      const n = panels.length;
      const own = data.quantities.findIndex((q) => q.panel === n + 1);
      panels.push(new Panel(n, own < 0 ? Math.min(n, data.quantities.length - 1) : own, -1));
      holder.append(panels[n].element);
    }
    return draw();
  };

  /** Show a quantity of a state, as a static picture has it. */
  const jump = (quantity, state) => {
    const panel = panels[0];
    panel.show(quantity);
    setState(state);
    root.scrollIntoView();
    panel.over.focus({ preventScroll: true });
  };

  const offerJumps = () => {
    for (const [k, { key: name }] of data.quantities.entries())
      for (const [n, state] of data.states.entries()) {
        const figure = document.getElementById(`${name}-${state.name}`);
        const label = figure?.querySelector(".label");
        if (!label) continue;
        const button = document.createElement("button");
        button.className = "ex-jump";
        button.type = "button";
        button.textContent = "explore";
        button.setAttribute("aria-label", `Explore ${data.quantities[k].title}, ${state.label}`);
        button.onclick = () => jump(k, n);
        label.append(button);
      }
  };

  const start = async () => {
    root.hidden = false;
    for (const link of document.querySelectorAll(".ex-link")) link.hidden = false;
    const needs = {
      states: data.states.length > 1, motion: hasMotion,
      truth: data.quantities.some((q) => q.truth.length),
      lengths: units.length > 1 && data.quantities.some((q) => q.unit === "length"),
    };
    for (const part of $$("[data-needs]")) part.hidden = !needs[part.dataset.needs];
    for (const [k, [name]] of units.entries()) $("#ex-unit").add(new Option(name, k));
    $("#ex-state").max = data.states.length - 1;
    $("#ex-state").oninput = (event) => setState(Number(event.target.value));
    $("#ex-shape").onchange = (event) => reshape(Number(event.target.value));
    $("#ex-unit").onchange = (event) => { shared.unit = Number(event.target.value); draw(); };
    $("#ex-count").onchange = (event) => arrange(Number(event.target.value));
    root.addEventListener("keydown", key);
    for (const button of $$("[data-do]")) button.onclick = () => acts[button.dataset.do]();
    const steps = Object.values(data.states.at(-1).arrays).map((k) => data.packed[k].step);
    $("#ex-step").textContent = data.quantities[0].unit === "length"
      ? `${written(data.packed[data.states.at(-1).arrays[Object.keys(data.quantities[0].terms[0])[0]]].step / pixel, 2)} px for the first quantity, others alike or finer`
      : `1/65535 of the range or finer than ${written(Math.max(...steps), 2)}`;
    box = await extent();
    [shared.x, shared.y] = [(box[0] + box[1]) / 2, (box[2] + box[3]) / 2];
    if (data.kind === "scores") { // of codes, the best one first, and errors in px
      $("#ex-what").textContent = "Field";
      shared.unit = units.length - 1;
      $("#ex-unit").value = shared.unit;
    }
    const fitting = innerWidth < 700 ? 1 : innerWidth < 1150 ? 2 : 3;
    $("#ex-count").value = Math.min(fitting, data.quantities.length);
    setState(shared.state);
    await arrange(Number($("#ex-count").value));
    offerJumps();
    new ResizeObserver(draw).observe($("#ex-panels"));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  };
  window.explorer = { data, shared, acts, draw, reshape, setState, setView, arrange, point, fieldOf, get panels() { return panels; }, ready: start() };
})();
