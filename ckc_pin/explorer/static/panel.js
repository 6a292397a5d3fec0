// Rows of the explorer's panel: sliders, quantities and margins, which are kept by name and updated by every report.
//
// Names and texts come from a user's files. They are only ever assigned to text nodes and attributes.

const DEGREE = Math.PI / 180;
const SLIDER_STEPS = 1000;  // of an arrow key, in a slider's range
const DIGITS = 6;
const ROUNDING = 1e-9;  // of a slider's range; smaller numbers are displayed as zero

let angleUnit = "rad";  // of what is displayed; messages are in rad

function displayFactor(unit) {
  return unit === "rad" && angleUnit === "deg" ? 1 / DEGREE : 1;
}

function displayUnit(unit) {
  return unit === "rad" ? angleUnit : unit;
}

function formatNumber(value) {
  return String(Number(value.toPrecision(DIGITS)));
}

function setText(node, text) {
  if (node.textContent !== text) { node.textContent = text; }
}

function createElement(tag, text) {
  const node = document.createElement(tag);
  node.textContent = text;
  return node;
}

function cloneTemplate(id) {
  return element(id).content.firstElementChild.cloneNode(true);
}

// A slider and a number field for one value, in SI units. While the user holds the slider or types a number, reports do
// not overwrite it. `act` has move(value), called on every change, and release(), called at the end of a gesture.
class SliderRow {
  constructor(name, act) {
    this.element = cloneTemplate("slider-row");
    this.element.dataset.name = name;
    this.name = name;
    this.act = act;
    this.value = 0;
    this.shownInfo = "";
    this.hasMoved = false;
    this.isHeld = false;  // by the mouse, a finger or a key
    this.isTyping = false;
    this.slider = this.element.querySelector(".slider");
    this.number = this.element.querySelector(".number");
    this.note = this.element.querySelector(".note");
    setText(this.element.querySelector(".name"), name);
    this.connect();
  }

  connect() {
    const release = () => { this.isHeld = false; this.release(); };
    this.slider.onpointerdown = () => {
      this.isHeld = true;
      // On the window, because the pointer may be elsewhere when it is released.
      window.addEventListener("pointerup", release, {once: true});
      window.addEventListener("pointercancel", release, {once: true});
    };
    this.slider.onkeydown = (event) => {
      if (/^(Arrow|Page|Home$|End$)/.test(event.key)) { this.isHeld = true; }
    };
    this.slider.onkeyup = release;
    this.slider.onblur = release;
    this.slider.oninput = () => this.move(Number(this.slider.value));
    this.slider.onchange = () => { if (!this.isHeld) { this.release(); } };
    this.number.oninput = () => { this.isTyping = true; };
    this.number.onchange = () => {
      const value = this.number.valueAsNumber;
      this.isTyping = false;
      if (Number.isFinite(value)) {
        this.move(value / displayFactor(this.unit));
        this.release();
      }
    };
    this.number.onblur = () => { this.isTyping = false; this.display(); };
  }

  move(value) {
    this.hasMoved = true;
    this.shownInfo = "";  // The next report has to be shown even if it is the same as before.
    this.act.move(value);
  }

  release() {
    if (!this.hasMoved) { return; }
    this.hasMoved = false;
    this.act.release();
  }

  // Shows a report's description of the value, unless that is shown already: there may be hundreds of rows.
  update(info) {
    const key = JSON.stringify([info, angleUnit]);
    if (key === this.shownInfo) { return; }
    this.shownInfo = this.isHeld ? "" : key;
    this.setScale(info);
  }

  setScale(info) {
    this.unit = info.unit;
    this.range = info.upper - info.lower;
    if (!this.isHeld) {
      this.slider.min = info.lower;
      this.slider.max = info.upper;
      this.slider.step = this.range / SLIDER_STEPS || "any";
    }
    const factor = displayFactor(info.unit), unit = displayUnit(info.unit);
    const ends = formatNumber(factor * info.lower) + " to " + formatNumber(factor * info.upper) + " " + unit;
    this.slider.title = (info.has_stops ? "limits: " : "") + ends;
    this.number.step = {rad: 0.01, deg: 1, m: 0.001}[unit] || "any";
    this.number.setAttribute("aria-label", this.name + " in " + unit);
    setText(this.element.querySelector(".unit"), unit);
    this.display();
  }

  setValue(value) {
    this.value = value;
    this.display();
  }

  setNote(text, isEnd) {
    this.note.classList.toggle("end", Boolean(isEnd));
    setText(this.note, text);
  }

  display() {
    const value = Math.abs(this.value) < ROUNDING * this.range ? 0 : this.value;
    const shown = formatNumber(displayFactor(this.unit) * value);
    if (!this.isHeld) { this.slider.value = this.value; }
    if (!this.isTyping && this.number.value !== shown) { this.number.value = shown; }
    this.slider.setAttribute("aria-valuetext", shown + " " + displayUnit(this.unit));
  }
}

// A quantity with its checkbox and lines [label, value].
class QuantityRow {
  constructor(name, toggle) {
    this.element = cloneTemplate("quantity-row");
    this.element.dataset.name = name;
    this.checkbox = this.element.querySelector("input");
    this.table = this.element.querySelector("table");
    this.checkbox.onchange = () => toggle(name, this.checkbox.checked);
  }

  setInfo(info) {
    setText(this.element.querySelector(".name"), info.label);
    setText(this.element.querySelector(".reason"), info.unavailable);
    this.checkbox.checked = info.on;
    this.checkbox.disabled = Boolean(info.unavailable);
  }

  setLines(lines) {
    while (this.table.rows.length > lines.length) { this.table.deleteRow(-1); }
    lines.forEach((line, k) => {
      const row = this.table.rows[k] || this.table.insertRow();
      line.forEach((text, column) => setText(row.cells[column] || row.insertCell(), text));
    });
  }
}

// A measure of conditioning: a bar that is full at the reference value, with the value and its meaning as text.
class MarginRow {
  constructor(name) {
    this.element = cloneTemplate("margin-row");
    this.element.dataset.name = name;
    this.gauge = this.element.querySelector(".gauge");
    setText(this.element.querySelector(".name"), name);
    this.gauge.setAttribute("aria-label", name);
  }

  set(value, reference) {
    const ratio = reference > 0 ? Math.min(1, value / reference) : 0;
    const [level, meaning] = MARGIN_LEVELS.find((entry) => ratio >= entry[2]);
    const text = value.toPrecision(3) + ", " + meaning;
    this.element.dataset.level = level;
    setText(this.element.querySelector(".value"), text);
    this.gauge.setAttribute("aria-valuenow", ratio.toPrecision(3));
    this.gauge.setAttribute("aria-valuetext", text);
    this.gauge.firstElementChild.style.width = 100 * ratio + "%";
  }
}

const MARGIN_LEVELS = [  // the name, its text, and the smallest ratio to the reference
  ["well", "well conditioned", 0.2],
  ["close", "close to singular", 0.01],
  ["singular", "singular", -Infinity],
];

// Rows by name in an element, in the order of the last report. `create` returns the row of a new name.
class RowList {
  constructor(container, create) {
    this.container = container;
    this.create = create;
    this.rows = new Map();
  }

  setNames(names) {
    const old = Array.from(this.rows.keys());
    if (old.length === names.length && old.every((name, k) => name === names[k])) { return; }
    this.rows = new Map(names.map((name) => [name, this.rows.get(name) || this.create(name)]));
    this.container.replaceChildren(...Array.from(this.rows.values(), (row) => row.element));
  }

  setInfos(infos) {
    this.setNames(infos.map((info) => info.name));
    infos.forEach((info) => this.rows.get(info.name).update(info));
  }

  forEach(action) {
    this.rows.forEach(action);
  }
}

// A parameter's slider tells its value in the files if it has another one now.
class ParameterRow extends SliderRow {
  setScale(info) {
    this.info = info;
    super.setScale(info);
    if (!this.isHeld) { this.setValue(info.value); }
    const isChanged = info.value !== info.default;
    const inFiles = formatNumber(displayFactor(info.unit) * info.default) + " " + displayUnit(info.unit);
    this.setNote(isChanged ? "changed; in the files: " + inFiles : "");
  }
}

// Parameters in one <details> per group, with a search in names and groups.
class ParameterList {
  constructor(container, search, createRow) {
    this.container = container;
    this.search = search;
    this.createRow = createRow;
    this.groups = new Map();  // each with its element, its summary and the RowList of its parameters
    search.oninput = () => this.filter();
  }

  setInfos(infos) {
    const byGroup = new Map();
    infos.forEach((info) => byGroup.set(info.group, [...(byGroup.get(info.group) || []), info]));
    const groups = Array.from(byGroup.keys(), (name) => this.groups.get(name) || this.createGroup(name));
    if (groups.length !== this.groups.size || groups.some((group) => !group.element.isConnected)) {
      this.groups = new Map(groups.map((group) => [group.name, group]));
      this.container.replaceChildren(...groups.map((group) => group.element));
    }
    byGroup.forEach((members, name) => {
      const group = this.groups.get(name);
      group.list.setInfos(members);
      setText(group.summary, name + " (" + members.length + ")");
    });
    this.filter();
  }

  createGroup(name) {
    const group = document.createElement("details"), rows = document.createElement("div");
    const summary = createElement("summary", "");
    group.className = "group";
    group.dataset.name = name;
    group.append(summary, rows);
    return {name: name, element: group, summary: summary, list: new RowList(rows, this.createRow)};
  }

  filter() {
    const wanted = this.search.value.trim().toLowerCase();
    this.groups.forEach((group, groupName) => {
      let count = 0;
      group.list.forEach((row, name) => {
        row.element.hidden = !(name + " " + groupName).toLowerCase().includes(wanted);
        if (!row.element.hidden) { count += 1; }
      });
      group.element.hidden = !count;
      if (wanted && count && wanted !== this.lastSearch) { group.element.open = true; }
    });
    this.lastSearch = wanted;
  }
}

// The singularity map with its axes and the present point. A click on it calls `go` with values by coordinate.
class MapCanvas {
  constructor(canvas, go) {
    this.canvas = canvas;
    this.go = go;
    this.picture = null;
    this.units = {};  // by coordinate
    this.values = {};
    canvas.onclick = (event) => this.click(event);
  }

  set(map) {
    this.map = map;
    this.canvas.hidden = !map.image;
    this.canvas.setAttribute("aria-label", map.x + (map.y && " and " + map.y) + ": " + map.note);
    this.picture = null;
    if (!map.image) { return; }
    const picture = new Image();
    picture.onload = () => {
      this.picture = picture;
      this.draw();
    };
    picture.src = "data:image/png;base64," + map.image;
  }

  setUnits(units) {
    this.units = units;
    this.draw();
  }

  setValues(values) {
    this.values = values;
    this.draw();
  }

  // The rectangle of the picture in the canvas, in CSS pixels.
  frame() {
    const left = this.map.y ? 62 : 14, width = this.canvas.clientWidth - left - 14;
    return {left: left, top: 10, width: width, height: this.map.y ? width : 50};
  }

  draw() {
    if (!this.picture || !this.canvas.clientWidth) { return; }  // not yet loaded, or in a closed section
    const frame = this.frame(), ratio = window.devicePixelRatio, height = frame.top + frame.height + 40;
    this.canvas.width = Math.round(ratio * this.canvas.clientWidth);
    this.canvas.height = Math.round(ratio * height);
    this.canvas.style.height = height + "px";
    const context = this.canvas.getContext("2d");
    context.scale(ratio, ratio);
    context.imageSmoothingEnabled = false;
    context.drawImage(this.picture, frame.left, frame.top, frame.width, frame.height);
    context.strokeStyle = "#777";
    context.strokeRect(frame.left, frame.top, frame.width, frame.height);
    this.drawLabels(context, frame);
    this.drawPoint(context, frame);
  }

  drawLabels(context, frame) {
    const bottom = frame.top + frame.height;
    context.fillStyle = "#222";
    context.font = "12px system-ui, sans-serif";
    const label = (name, range) => {
      const factor = displayFactor(this.units[name]);
      const ends = range.map((value) => String(Number((factor * value).toPrecision(3))));
      return [...ends, name + " (" + displayUnit(this.units[name]) + ")"];
    };
    const write = (text, x, y, align) => {
      context.textAlign = align;
      context.fillText(text, x, y, frame.width);
    };
    const [left, right, x] = label(this.map.x, this.map.x_range);
    write(left, frame.left, bottom + 15, "left");
    write(right, frame.left + frame.width, bottom + 15, "right");
    write(x, frame.left + frame.width / 2, bottom + 32, "center");
    if (!this.map.y) { return; }
    const [low, high, y] = label(this.map.y, this.map.y_range);
    write(low, frame.left - 6, bottom, "right");
    write(high, frame.left - 6, frame.top + 10, "right");
    context.save();
    context.translate(14, frame.top + frame.height / 2);
    context.rotate(-Math.PI / 2);
    write(y, 0, 0, "center");
    context.restore();
  }

  drawPoint(context, frame) {
    const fraction = (name, [low, high], turns) => {
      let value = this.values[name];
      if (turns) { value -= 2 * Math.PI * Math.floor((value - low) / (2 * Math.PI)); }
      return (value - low) / (high - low);
    };
    const u = fraction(this.map.x, this.map.x_range, this.map.x_turns);
    const v = this.map.y ? fraction(this.map.y, this.map.y_range, this.map.y_turns) : 0.5;
    if (!(u >= 0 && u <= 1 && v >= 0 && v <= 1)) { return; }
    const x = frame.left + u * frame.width, y = frame.top + (1 - v) * frame.height;
    const arm = 8;
    for (const [width, colour] of [[5, "#FFF"], [2, "#000"]]) {  // seen on every ground
      context.lineWidth = width;
      context.strokeStyle = colour;
      context.beginPath();
      context.moveTo(x - arm, y);
      context.lineTo(x + arm, y);
      context.moveTo(x, y - arm);
      context.lineTo(x, y + arm);
      context.stroke();
    }
  }

  click(event) {
    if (!this.picture) { return; }
    const frame = this.frame();
    const u = (event.offsetX - frame.left) / frame.width, v = 1 - (event.offsetY - frame.top) / frame.height;
    if (!(u >= 0 && u <= 1 && v >= 0 && v <= 1)) { return; }
    const interpolate = ([low, high], fraction) => low + fraction * (high - low);
    const values = {[this.map.x]: interpolate(this.map.x_range, u)};
    if (this.map.y) { values[this.map.y] = interpolate(this.map.y_range, v); }
    this.go(values);
  }
}
