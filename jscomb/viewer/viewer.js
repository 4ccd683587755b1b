/* The viewer of one element: its state, its controls, its address. */
function makeViewer(root, { scenes, colours }) {
  const lut = Uint8Array.from(atob(colours), c => c.charCodeAt(0));
  const paint = makePainter(lut);
  const large = paint && scenes.find(each => Math.max(each.width, each.height) > paint.largest);
  if (!paint || large) {
    const why = paint ? `${large.name} is ${large.width}x${large.height} pixels; this browser shows at most ${paint.largest}.`
      : "This viewer needs WebGL 2, which this browser does not have or has switched off.";
    root.dataset.ready = "failed";
    root.append(made("p", { className: "failed", textContent: why }));
    return;
  }
  const state = { scene: 0, panes: [], active: 0, stops: 0, curve: "sRGB", zoom: 1, x: .5, y: .5, slide: false, split: .5, ranges: {}, crops: [] };
  const decoded = new Map();
  const scene = () => scenes[state.scene];
  const position = name => scene().images.findIndex(image => image.name === name);
  const reference = () => scene().reference === null ? null : scene().images[scene().reference];
  const range = kind => state.ranges[kind] ?? (ERRORS[kind] ?? ERRORS.relative).range;

  /* What a pane may show of an image: of all images of the scene. */
  function kinds() {
    const maps = new Set(scene().images.flatMap(image => Object.keys(image.maps)));
    return ["image", ...(reference() ? ["relative", "signed"] : []), ...maps];
  }
  const shown = pane => pane.image === FIRST ? state.panes[0] : pane;

  /* Pixels, if they are decoded; else null, and they will be. */
  function pixels(blob) {
    const { id, type, channels } = blob, { width, height } = scene();
    if (!decoded.has(id)) {
      decoded.set(id, null);
      const holder = root.querySelector(`[data-blob="${id}"]`), count = width * height * channels;
      unpacked(holder.textContent.trim(), type, count).then(values => {
        decoded.set(id, { width, height, channels, values });
        holder.remove();
        draw();
      });
    }
    return decoded.get(id);
  }
  function at({ channels, values, width }, x, y) {
    const start = (y * width + x) * channels;
    return Array.from(values.subarray(start, start + channels), v => values instanceof Uint16Array ? half(v) : v);
  }
  /* The error of one pixel, as the painter has it. */
  function errorAt(kind, image, x, y) {
    if (kind in image.maps) return at(pixels(image.maps[kind]) ?? { channels: 0, values: new Float32Array(), width: 0 }, x, y)[0];
    const a = pixels(image.pixels), r = pixels(reference().pixels);
    if (!a || !r) return undefined;
    const v = at(a, x, y), w = at(r, x, y), mean = all => all.reduce((s, i) => s + i, 0) / all.length;
    const weight = mean(w) ** 2 + scene().epsilon, d = v.map((i, c) => i - w[c]);
    return kind === "signed" ? mean(d) / Math.sqrt(weight) : mean(d.map(i => i * i)) / weight;
  }

  /* One image or error into a canvas; whether it was all there. */
  function render(canvas, image, kind, origin, scale) {
    const a = pixels(image.pixels), map = image.maps[kind] && pixels(image.maps[kind]);
    const r = kind === "image" || image.maps[kind] ? a : reference() && pixels(reference().pixels);
    if (!(kind in ERRORS) && kind !== "image" && !image.maps[kind]) kind = "image";
    const lacks = !["image", "relative", "signed"].includes(kind) && !image.maps[kind];
    if (lacks || !a || !r || map === null) {
      canvas.getContext("2d").clearRect(0, 0, canvas.width, canvas.height);
      return Boolean(lacks);
    }
    paint(canvas, { image: a, reference: r, map, kind, origin, scale, gain: 2 ** state.stops * scene().unit, curve: state.curve,
      range: range(kind), logarithmic: ERRORS[kind]?.logarithmic ?? false, epsilon: scene().epsilon });
    return true;
  }

  /* --- the page ---------------------------------------------------------------------------- */
  const control = {};
  const bar = made("div", { className: "bar" });
  const label = (text, ...controls) => made("label", {}, text + " ", ...controls);
  const button = (text, title, press) => made("button", { textContent: text, title, onclick: () => { press(); draw(); } });
  control.scene = made("select", { onchange: event => { enter(Number(event.target.value)); draw(); } });
  control.count = made("select", { onchange: event => { count(Number(event.target.value)); draw(); } });
  control.stops = made("input", { type: "range", step: .25, title: "in stops (↑ ↓)", oninput: event => { state.stops = Number(event.target.value); draw(); } });
  control.stopsText = made("output");
  control.curve = made("select", { onchange: event => { state.curve = event.target.value; draw(); } });
  control.slide = made("input", { type: "checkbox", onchange: event => { state.slide = event.target.checked; draw(); } });
  options(control.count, { 1: "1", 2: "2", 3: "3", 4: "4" }, 1);
  options(control.curve, Object.fromEntries(Object.keys(CURVES).map(name => [name, name])), state.curve);
  if (scenes.length > 1) bar.append(label("scene", control.scene));
  bar.append(label("panes", control.count), label("exposure", control.stops, control.stopsText), label("curve", control.curve),
    label("slide", control.slide), button("auto", "automatic exposure (a)", () => state.stops = scene().stops),
    button("fit", "the whole image (0)", fit), button("1:1", "one pixel to one (z)", whole));
  const panes = made("div", { className: "panes" });
  const scaleBar = made("div", { className: "colours" }), insets = made("div", { className: "insets" });
  const help = made("details", { className: "help" }, made("summary", { textContent: "keys" }),
    made("dl", {}, ...HELP.flatMap(([keys, text]) => [made("dt", { textContent: keys }), made("dd", { textContent: text })])));
  root.append(bar, panes, scaleBar, insets, help);

  const views = [];  // of each pane: its elements
  function makeView(number) {
    const canvas = made("canvas"), cross = made("div", { className: "cross", hidden: true }), line = made("div", { className: "line" }), box = made("div", { className: "box" });
    const image = made("select", { onchange: event => { flip(number, event.target.value); draw(); } });
    const kind = made("select", { onchange: event => { state.panes[number].kind = event.target.value; draw(); } });
    const note = made("div", { className: "note" }), value = made("div", { className: "value" });
    const stage = made("div", { className: "stage" }, canvas, cross, line, box);
    const view = { number, canvas, cross, line, box, image, kind, note, value, stage,
      element: made("div", { className: "pane" }, made("div", { className: "head" }, image, kind), note, stage, value) };
    listen(view);
    return view;
  }

  /* --- changes of the state --------------------------------------------------------------- */
  function enter(number) {
    state.scene = number;
    const last = scene().images.length - 1;
    for (const pane of state.panes) {
      for (const which of ["image", "before"]) pane[which] = Math.min(pane[which], last);
      if (!kinds().includes(pane.kind)) pane.kind = "image";
    }
    state.crops = [];
    state.stops = scene().stops;
  }
  function count(number) {
    while (state.panes.length < number) {
      const next = state.panes.length;
      const errors = next === 1 && reference();
      state.panes.push({ image: errors ? FIRST : Math.min(next, scene().images.length - 1), before: 0, kind: errors ? "relative" : "image" });
    }
    state.panes.length = number;
    state.active = Math.min(state.active, number - 1);
  }
  function flip(number, image) {
    const pane = state.panes[number];
    image = Number(image);
    if (image === FIRST || pane.image === FIRST) { pane.image = image; return; }
    if (image !== pane.image) { pane.before = pane.image; pane.image = image; }
  }
  function flipKey(step, exactly) {
    const all = scene().images.length, pane = shown(state.panes[state.active]);
    const next = exactly ?? (pane.image + step + all) % all;
    if (next < all) flip(state.panes.indexOf(pane), next);
  }
  const following = (list, item, step = 1) => list[(list.indexOf(item) + step + list.length) % list.length];
  function fit() { Object.assign(state, { zoom: 1, x: .5, y: .5 }); }
  function whole() { state.zoom = 1 / views[0].fit / (devicePixelRatio || 1); }
  function zoomBy(factor, fx = state.x, fy = state.y) {
    const zoom = Math.min(256 / views[0].fit, Math.max(.5, state.zoom * factor)), k = state.zoom / zoom;
    Object.assign(state, { zoom, x: fx + (state.x - fx) * k, y: fy + (state.y - fy) * k });
  }
  function changeRange(factor) {
    const kind = state.panes.map(pane => pane.kind).find(each => each !== "image");
    if (!kind) return;
    const [low, high] = range(kind);
    state.ranges[kind] = [round(low * factor, 3), round(high * factor, 3)];
  }
  const KEYS = {
    ArrowRight: () => flipKey(1), ArrowLeft: () => flipKey(-1), ArrowUp: () => state.stops += .5, ArrowDown: () => state.stops -= .5,
    a: () => state.stops = scene().stops, s: () => state.slide = !state.slide, p: () => count(state.panes.length % 4 + 1),
    e: () => { const pane = state.panes[state.active]; pane.kind = following(kinds(), pane.kind); },
    t: () => state.curve = following(Object.keys(CURVES), state.curve), n: () => enter((state.scene + 1) % scenes.length),
    "[": () => changeRange(10 ** -.5), "]": () => changeRange(10 ** .5), "+": () => zoomBy(1.5), "=": () => zoomBy(1.5), "-": () => zoomBy(1 / 1.5),
    0: fit, z: whole, c: () => state.crops = [],
  };
  function press(event) {
    if (event.ctrlKey || event.altKey || event.metaKey || /^(INPUT|SELECT|TEXTAREA)$/.test(event.target.tagName)) return;
    const digit = Number(event.key);
    if (digit >= 1) flipKey(0, digit - 1);
    else if (event.key in KEYS) KEYS[event.key]();
    else return;
    event.preventDefault();
    draw();
  }

  /* --- pointers --------------------------------------------------------------------------- */
  const inside = (view, event) => { const r = view.canvas.getBoundingClientRect(); return [event.clientX - r.left, event.clientY - r.top]; };
  /* The place in the image, in its pixels, under a place in the pane. */
  function under(view, [px, py]) {
    const { width, height } = scene(), s = view.fit * state.zoom;
    return [state.x * width + (px - view.width / 2) / s, state.y * height + (py - view.height / 2) / s];
  }
  function listen(view) {
    let drag = null;
    view.stage.addEventListener("wheel", event => {
      const [x, y] = under(view, inside(view, event));
      zoomBy(Math.exp(-event.deltaY / 400), x / scene().width, y / scene().height);
      event.preventDefault();
      draw();
    }, { passive: false });
    view.stage.addEventListener("pointerdown", event => {
      const place = inside(view, event);
      const onLine = state.slide && Math.abs(place[0] - state.split * view.width) < 12;
      drag = { last: place, start: under(view, place), does: event.shiftKey ? "crop" : onLine ? "split" : "pan" };
      view.stage.setPointerCapture(event.pointerId);
      root.focus({ preventScroll: true });
    });
    view.stage.addEventListener("pointermove", event => {
      const place = inside(view, event);
      if (state.active !== view.number && !drag) { state.active = view.number; draw(); }
      point(under(view, place));
      if (!drag) return;
      const s = view.fit * state.zoom;
      if (drag.does === "split") state.split = Math.min(1, Math.max(0, place[0] / view.width));
      else if (drag.does === "pan") {
        state.x -= (place[0] - drag.last[0]) / s / scene().width;
        state.y -= (place[1] - drag.last[1]) / s / scene().height;
      } else drag.crop = rectangle(drag.start, under(view, place));
      drag.last = place;
      state.cropping = drag.crop;
      draw();
    });
    view.stage.addEventListener("pointerup", () => {
      if (drag?.crop && drag.crop[2] > 1 && drag.crop[3] > 1) state.crops.push(drag.crop);
      drag = state.cropping = null;
      draw();
    });
    view.stage.addEventListener("pointerleave", () => point(null));
  }
  function rectangle([x0, y0], [x1, y1]) {
    const { width, height } = scene(), cut = (v, most) => Math.min(most, Math.max(0, Math.round(v)));
    const [left, right] = [cut(Math.min(x0, x1), width), cut(Math.max(x0, x1), width)];
    const [top, bottom] = [cut(Math.min(y0, y1), height), cut(Math.max(y0, y1), height)];
    return [left, top, right - left, bottom - top];
  }
  /* The values of a pixel in every pane, and a cross there. */
  let pointed = null;
  function point(place) {
    pointed = place;
    const { width, height } = scene(), [x, y] = place ? place.map(Math.floor) : [-1, -1];
    const off = x < 0 || y < 0 || x >= width || y >= height;
    for (const view of views.slice(0, state.panes.length)) {
      view.cross.hidden = off;
      if (off) { view.value.textContent = "\u00a0"; continue; }
      const s = view.fit * state.zoom, pane = state.panes[view.number], left = (x + .5 - state.x * width) * s + view.width / 2;
      const { image: after, before } = shown(pane), image = scene().images[state.slide && left < state.split * view.width ? before : after];
      view.cross.style.left = `${left}px`;
      view.cross.style.top = `${(y + .5 - state.y * height) * s + view.height / 2}px`;
      const a = pixels(image.pixels), values = a ? at(a, x, y).map(v => (v * scene().unit).toPrecision(4)) : [];
      const kind = pane.kind === "image" ? reference() && "relative" : pane.kind;
      const error = kind && (kind in image.maps || reference()) ? errorAt(kind, image, x, y) : undefined;
      view.value.textContent = `${state.slide ? `${image.name} ` : ""}(${x}, ${y})  ${values.join("  ")}` + (error === undefined ? "" : `   ${ERRORS[kind]?.text ?? kind} ${error.toPrecision(3)}`);
    }
  }

  /* --- drawing ---------------------------------------------------------------------------- */
  let asked = false;
  function draw() {
    root.dataset.ready = "";
    if (!asked) { asked = true; requestAnimationFrame(() => { asked = false; paintAll(); }); }
  }
  function paintAll() {
    while (views.length < state.panes.length) views.push(makeView(views.length));
    const ratio = devicePixelRatio || 1, { width, height } = scene(), all = state.panes.length;
    const room = columns => (innerHeight - 120) / Math.ceil(all / columns) - 88;
    const fits = columns => Math.min(panes.clientWidth / columns / width, room(columns) / height);
    const columns = [1, 2, 3, 4].slice(0, all).reduce((best, each) => fits(each) > fits(best) ? each : best);
    panes.style.gridTemplateColumns = `repeat(${columns}, minmax(0, 1fr))`;
    if (panes.children.length !== state.panes.length) panes.replaceChildren(...views.slice(0, state.panes.length).map(view => view.element));
    let whole = true;
    for (const [number, pane] of state.panes.entries()) {
      const view = views[number], image = scene().images[shown(pane).image];
      view.width = Math.max(64, view.stage.clientWidth);
      view.height = Math.round(Math.max(160, Math.min(view.width * height / width, room(columns))));
      view.fit = Math.min(view.width / width, view.height / height);
      view.stage.style.height = `${view.height}px`;
      resize(view.canvas, view.width * ratio, view.height * ratio);
      const s = view.fit * state.zoom, scale = 1 / (s * ratio);
      const origin = [state.x * width - view.width / 2 / s, state.y * height - view.height / 2 / s];
      whole = render(view.canvas, image, pane.kind, origin, scale) && whole;
      if (state.slide) {
        const before = scene().images[shown(pane).before], left = Math.round(state.split * view.canvas.width);
        view.left ??= made("canvas");
        resize(view.left, view.width * ratio, view.height * ratio);
        whole = render(view.left, before, pane.kind, origin, scale) && whole;
        const context = view.canvas.getContext("2d");
        context.clearRect(0, 0, left, view.canvas.height);
        if (left > 0) context.drawImage(view.left, 0, 0, left, view.left.height, 0, 0, left, view.left.height);
        view.line.style.left = `${state.split * view.width}px`;
        view.line.dataset.before = before.name;
      }
      view.line.hidden = !state.slide;
      outline(view, origin, s);
      view.element.classList.toggle("active", number === state.active && state.panes.length > 1);
      const names = Object.fromEntries(scene().images.map((each, i) => [i, `${i + 1}  ${each.name}`]));
      options(view.image, number ? { [FIRST]: "as in the first pane", ...names } : names, pane.image);
      options(view.kind, Object.fromEntries(kinds().map(kind => [kind, ERRORS[kind]?.text ?? kind])), pane.kind);
      view.kind.hidden = kinds().length < 2;
      view.note.textContent = (pane.image === FIRST ? [image.name, image.note] : [image.note]).filter(Boolean).join(" · ");
    }
    Object.assign(control.stops, { min: scene().stops - 12, max: scene().stops + 12, value: state.stops });
    control.stopsText.value = `${state.stops >= 0 ? "+" : "−"}${Math.abs(state.stops)}`;
    Object.assign(control.curve, { value: state.curve });
    control.slide.checked = state.slide;
    control.count.value = state.panes.length;
    options(control.scene, Object.fromEntries(scenes.map((each, i) => [i, each.name])), state.scene);
    point(pointed);
    drawColours();
    whole = drawInsets() && whole;
    address();
    root.dataset.ready = whole ? "yes" : "";
  }
  function resize(canvas, width, height) {
    [width, height] = [Math.round(width), Math.round(height)];
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  }
  function outline(view, [left, top], s) {
    const all = [...state.crops, ...(state.cropping ? [state.cropping] : [])];
    view.box.replaceChildren(...all.map(([x, y, w, h], number) => {
      const element = made("div", { className: `c${number % 4}` });
      Object.assign(element.style, { left: `${(x - left) * s}px`, top: `${(y - top) * s}px`, width: `${w * s}px`, height: `${h * s}px` });
      return element;
    }));
  }
  /* A colour bar for each kind of error that some pane shows. */
  function drawColours() {
    const used = [...new Set(state.panes.map(pane => pane.kind))].filter(kind => kind !== "image");
    if (scaleBar.contains(document.activeElement) && document.activeElement.tagName === "INPUT" && scaleBar.dataset.used === used.join()) return;
    scaleBar.dataset.used = used.join();
    scaleBar.replaceChildren(...used.map(kind => {
      const [low, high] = range(kind), canvas = made("canvas", { width: 256, height: 1 }), context = canvas.getContext("2d");
      const picture = context.createImageData(256, 1);
      for (let i = 0; i < 256; i++) {
        const e = i / 127.5 - 1, share = Math.sqrt(Math.abs(e)), full = e > 0 ? [217, 26, 26] : [26, 77, 230];
        const rgb = kind === "signed" ? full.map(c => 255 + (c - 255) * share) : lut.subarray(3 * i, 3 * i + 3);
        picture.data.set([...rgb, 255], 4 * i);
      }
      context.putImageData(picture, 0, 0);
      const limit = which => made("input", { type: "number", step: "any", value: round(range(kind)[which], 3), title: which ? "highest error" : "lowest error",
        onchange: event => {
          const changed = [...range(kind)], logarithmic = ERRORS[kind]?.logarithmic;
          changed[which] = Number(event.target.value);
          if (changed[0] < changed[1] && !(logarithmic && changed[0] <= 0)) state.ranges[kind] = changed;
          draw();
        } });
      const ends = kind === "signed" ? [made("span", { textContent: `−${round(high, 3)}` }), canvas, limit(1)] : [limit(0), canvas, limit(1)];
      return made("div", {}, made("span", { textContent: ERRORS[kind]?.text ?? kind }), ...ends,
        ...(ERRORS[kind]?.logarithmic ? [made("span", { textContent: "logarithmic" })] : []));
    }));
  }
  /* For each crop a row: that crop of every image, at whole multiples where it is small. */
  function drawInsets() {
    const ratio = devicePixelRatio || 1, kind = state.panes.map(pane => pane.kind).find(each => each !== "image");
    let whole = true;
    insets.replaceChildren(...state.crops.map((crop, number) => {
      const [x, y, w, h] = crop, times = INSET / w >= 1 ? Math.floor(INSET / w) : INSET / w;
      const cell = (image, shownKind) => {
        const canvas = made("canvas", { width: Math.round(w * times * ratio), height: Math.max(1, Math.round(h * times * ratio)) });
        canvas.style.width = `${w * times}px`;
        whole = render(canvas, image, shownKind, [x, y], 1 / (times * ratio)) && whole;
        return canvas;
      };
      const cells = scene().images.map(image => {
        const error = reference() && image !== reference() ? cropError(image, crop) : undefined;
        const text = image.name + (error === undefined ? "" : `  ${error.toPrecision(3)}`);
        return made("figure", {}, cell(image, "image"), ...(kind ? [cell(image, kind)] : []), made("figcaption", { textContent: text }));
      });
      const remove = made("button", { textContent: "×", title: "remove this inset", onclick: () => { state.crops.splice(number, 1); draw(); } });
      return made("div", { className: `row c${number % 4}` }, made("div", { className: "crop" }, `${w}x${h} at (${x}, ${y}) `, remove), ...cells);
    }));
    return whole;
  }
  /* The mean relative squared error of a crop. */
  const measured = new Map();
  function cropError(image, crop) {
    const key = [image.pixels.id, ...crop].join(), [left, top, width, height] = crop;
    if (measured.has(key) || width * height > MOST_MEASURED) return measured.get(key);
    let sum = 0;
    for (let y = top; y < top + height; y++) for (let x = left; x < left + width; x++) {
      const error = errorAt("relative", image, x, y);
      if (error === undefined) return undefined;
      sum += error;
    }
    measured.set(key, sum / (width * height));
    return measured.get(key);
  }

  /* --- the address ------------------------------------------------------------------------ */
  function written() {
    const words = new URLSearchParams(), name = i => i === FIRST ? "" : scene().images[i].name;
    words.set("scene", scene().name);
    for (const pane of state.panes) words.append("pane", JSON.stringify([name(pane.image), pane.kind, name(pane.before)]));
    for (const key of ["stops", "zoom", "x", "y"]) words.set(key, round(state[key], 6));
    words.set("curve", state.curve);
    if (state.slide) words.set("slide", round(state.split, 4));
    for (const [kind, limits] of Object.entries(state.ranges)) words.append("range", JSON.stringify([kind, ...limits]));
    for (const crop of state.crops) words.append("crop", crop.join());
    return words.toString();
  }
  function read(text) {
    const words = new URLSearchParams(text), number = (key, otherwise) => words.has(key) && isFinite(words.get(key)) ? Number(words.get(key)) : otherwise;
    const found = scenes.findIndex(each => each.name === words.get("scene"));
    state.panes = [];
    enter(Math.max(0, found));
    for (const each of words.getAll("pane").slice(0, 4)) {
      const [name, kind, before] = JSON.parse(each), image = name === "" && state.panes.length ? FIRST : Math.max(0, position(name));
      state.panes.push({ image, kind: kinds().includes(kind) ? kind : "image", before: Math.max(0, position(before)) });
    }
    if (!state.panes.length) count(reference() || scene().images.length > 1 ? 2 : 1);
    for (const key of ["stops", "zoom", "x", "y"]) state[key] = number(key, state[key]);
    if (words.get("curve") in CURVES) state.curve = words.get("curve");
    state.slide = words.has("slide");
    state.split = number("slide", state.split);
    for (const each of words.getAll("range")) { const [kind, ...limits] = JSON.parse(each); state.ranges[kind] = limits; }
    state.crops = words.getAll("crop").map(each => each.split(",").map(Number)).filter(crop => crop.length === 4);
  }
  let last = "";
  function address() {
    if (root.dataset.address !== "yes") return;
    last = `#${written()}`;
    try { history.replaceState(null, "", last); } catch { /* a page within another has no address of its own */ }
  }
  const start = () => {
    try { read(root.dataset.address === "yes" ? location.hash.slice(1) : ""); } catch { state.panes = []; read(""); }
    draw();
  };
  addEventListener("hashchange", () => { if (location.hash !== last) start(); });
  addEventListener("resize", draw);
  root.addEventListener("change", event => event.target.type === "range" || event.target.blur());  // keys are the viewer's again
  root.tabIndex = 0;
  (root.dataset.address === "yes" ? window : root).addEventListener("keydown", press);
  root.viewer = { state, draw, written };
  start();
}

for (const root of document.querySelectorAll(".jscomb-viewer:not([data-ready])")) {
  makeViewer(root, JSON.parse(root.querySelector("[data-scenes]").textContent));
}
