/*
 * The player of recorded flights: startReplays(root, data) builds it inside an element.
 *
 * `data` is what uavnav/report/replays.py records; drawing.js draws it, and box.js what is in 3D. Nothing moves before the reader asks for it.
 */

const SPEEDS = [0.25, 1, 4];
const TYPES = {
  uint8: [1, "getUint8"], int8: [1, "getInt8"], uint16: [2, "getUint16"], int16: [2, "getInt16"],
  float32: [4, "getFloat32"],
}; // of a field: its bytes, and what reads it

// ---------------------------------------------------------------------------------------------- reading a flight

async function inflate(text) {
  const packed = Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Response(stream).arrayBuffer();
}

/** The fields of a flight by name: each a function of the step (and the column) that gives the number. */
async function unpack(flight, fields) {
  const view = new DataView(await inflate(flight.bytes));
  const read = {};
  let start = 0;
  for (const { name, type, unit, chosen, columns } of fields) {
    const [bytes, getter] = TYPES[type];
    const rows = flight.steps + (chosen ? 0 : 1); // the last pose chooses nothing
    const first = start;
    read[name] = (step, column = 0) => view[getter](first + bytes * (column * rows + step), true) * unit;
    start += bytes * rows * columns;
  }
  return read;
}

/** A cell in words, and where it flies if that has a name. */
function named({ algorithm, label, mode, place }) {
  return [`${algorithm.toUpperCase()} ${label}`, mode, ...(place ? [place.title] : [])].join(", ");
}

/** What stands around a flight at a step: { circles, goal }. */
function around({ layouts }, { place }, { layout }, step) {
  if (!place) return { circles: layouts[layout] };
  const set = place.sets[layout];
  if (place.world.depth) return { spheres: spheresAt(place.world, set.circles, step) };
  return { circles: new TASKS[place.task](place).obstacles(set, step), goal: set.goal };
}

/** A drone as drawArena or drawBox takes it: where it is at a step, what it senses, and the trail of so many steps. */
function droneAt(world, read, step, trail = Infinity) {
  const inBox = Boolean(world.depth);
  const place = (at) => (inBox ? ["x", "y", "z"] : ["x", "y"]).map((axis) => read[axis](at));
  const [here, angle] = [place(step), radians(read.heading(step))];
  const names = inBox ? ["right", "up", "forward", "proximity"] : ["right", "forward", "proximity"];
  const slots = Array.from({ length: world.n_slots }, (_, slot) => names.map((name) => read[name](step, slot)));
  const first = Math.max(0, step - trail);
  const flown = Array.from({ length: step - first + 1 }, (_, at) => place(first + at));
  if (inBox) {
    const axes = bodyAxes({ yaw: angle, pitch: radians(read.pitch(step)) });
    return { place: here, axes, trail: flown, sensed: sensedInBox(world, here, axes, slots) };
  }
  const pose = { x: here[0], y: here[1], angle };
  return { pose, trail: flown, sensed: sensedPoints(world, pose, slots) };
}

function crashedAt(flight, step) {
  return step === flight.steps && flight.ended === "collision";
}

function ending(flight) {
  return `${flight.ended} at ${flight.steps}`;
}

// ---------------------------------------------------------------------------------------------- the page's elements

function make(parent, tag, properties = {}) {
  return parent.appendChild(Object.assign(document.createElement(tag), properties));
}

function labelled(parent, text, tag, properties = {}) {
  const label = make(parent, "label", { className: "replay-label" });
  make(label, "span", { textContent: text });
  return make(label, tag, properties);
}

function button(parent, text, name) {
  const made = make(parent, "button", { type: "button", textContent: text, className: "replay-button", title: name });
  made.setAttribute("aria-label", name);
  return made;
}

function build(root) {
  const player = make(root, "div", { className: "replay", tabIndex: 0 });
  player.setAttribute("role", "group");
  player.setAttribute("aria-label", "Player of flights. Space plays and pauses, left and right arrows step.");
  const choice = make(player, "div", { className: "replay-row" });
  const cell = labelled(choice, "policy", "select");
  const seed = labelled(choice, "seed", "select");
  const layout = labelled(choice, "obstacles", "select");
  const stage = make(player, "div", { className: "replay-stage" });
  const arena = make(make(stage, "div", { className: "replay-arena" }), "canvas");
  arena.setAttribute("role", "img");
  const transport = make(stage, "div", { className: "replay-row replay-transport" });
  const back = button(transport, "◀", "one step back");
  const play = button(transport, "Play", "play");
  const forward = button(transport, "▶", "one step forward");
  const speed = labelled(transport, "speed", "select");
  fill(speed, SPEEDS.map((times) => [times, `${times}×`]), 1);
  const slider = labelled(transport, "step", "input", { type: "range", min: 0, max: 0, value: 0 });
  slider.parentElement.classList.add("replay-slider");
  const status = make(stage, "p", { className: "replay-status" });
  status.setAttribute("aria-live", "polite");
  const side = make(stage, "figure", { className: "replay-side" });
  const caption = make(side, "figcaption");
  const values = make(side, "canvas");
  values.setAttribute("role", "img");
  return { player, cell, seed, layout, arena, caption, values, back, play, forward, slider, speed, status };
}

/** Give a select its choices [value, text], and keep what was chosen if it is still there. */
function fill(select, choices, wanted = select.value) {
  select.replaceChildren(...choices.map(([value, text]) => new Option(text, value)));
  if (choices.some(([value]) => String(value) === String(wanted))) select.value = wanted;
}

// ---------------------------------------------------------------------------------------------- the player

class Player {
  constructor(root, data) {
    this.data = data;
    this.parts = build(root);
    this.flight = null; // the one that is shown
    this.read = null; // its fields, once it is unpacked
    this.step = 0;
    this.playing = false;
    fill(this.parts.cell, data.cells.map((one, place) => [place, named(one)]));
    this.listen();
    this.chooseCell();
  }

  listen() {
    const { player, cell, seed, layout, back, play, forward, slider } = this.parts;
    cell.addEventListener("change", () => this.chooseCell());
    seed.addEventListener("change", () => this.chooseSeed());
    layout.addEventListener("change", () => this.load());
    play.addEventListener("click", () => this.toggle());
    back.addEventListener("click", () => this.stepBy(-1));
    forward.addEventListener("click", () => this.stepBy(1));
    slider.addEventListener("input", () => this.show(Number(slider.value)));
    player.addEventListener("keydown", (event) => this.press(event));
    watchLooks(player, () => this.draw(), () => this.recolour());
  }

  recolour() {
    this.colours = readColours(this.parts.player);
    this.font = `12px ${getComputedStyle(this.parts.player).fontFamily}`;
    this.draw();
  }

  /** Keys that an element uses by itself are left to it. */
  press(event) {
    const { tagName } = event.target;
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (event.altKey || event.ctrlKey || event.metaKey || tagName === "SELECT") return;
    if (event.key === " " && tagName !== "BUTTON") this.toggle();
    else if (step && tagName !== "INPUT") this.stepBy(step);
    else return;
    event.preventDefault();
  }

  chooseCell() {
    const flights = this.data.cells[this.parts.cell.value].flights;
    const seeds = [...new Set(flights.map(({ seed }) => seed))];
    fill(this.parts.seed, seeds.map((seed) => [seed, seed]));
    this.chooseSeed();
  }

  chooseSeed() {
    const { cell, seed, layout } = this.parts;
    const flights = this.data.cells[cell.value].flights.filter((flight) => flight.seed === Number(seed.value));
    fill(layout, flights.map((flight) => [flight.layout, `${flight.layout + 1} (${ending(flight)})`]));
    this.load();
  }

  async load() {
    const { cell, seed, layout, slider, status } = this.parts;
    this.pause();
    this.cell = this.data.cells[cell.value];
    this.world = this.cell.place?.world ?? this.data.world;
    this.actions = this.cell.place?.actions ?? this.data.actions;
    this.grid = gridOf(this.actions);
    this.parts.arena.style.aspectRatio = this.world.depth ? shapeOf(this.world) : this.world.width / this.world.height;
    const flight = this.cell.flights.find(
      (one) => one.seed === Number(seed.value) && one.layout === Number(layout.value),
    );
    this.flight = flight;
    this.read = null;
    status.textContent = "unpacking the flight …";
    try {
      const read = await unpack(flight, this.cell.place?.fields ?? this.data.fields);
      if (this.flight !== flight) return; // another was chosen meanwhile
      this.read = read;
      slider.max = flight.steps;
      this.show(0);
    } catch (error) {
      if (this.flight === flight) status.textContent = `This flight cannot be shown in this browser (${error.message}).`;
    }
  }

  toggle() {
    if (this.playing) this.pause();
    else this.start();
  }

  start() {
    if (!this.read) return;
    this.playing = true;
    this.mark();
    if (this.step === this.flight.steps) this.show(0);
    let due = 0; // steps, whole and parts
    everyPicture(this, (seconds) => {
      due += seconds * STEPS_PER_SECOND * Number(this.parts.speed.value);
      const whole = Math.floor(due);
      due -= whole;
      if (whole) this.show(this.step + whole);
      if (this.step === this.flight.steps) this.pause();
    });
  }

  pause() {
    const played = this.playing;
    this.playing = false;
    this.mark();
    if (played) this.describe(); // once more, now that changes are read out
  }

  /** What the button says, and whether the words are read out: not while they change all the time. */
  mark() {
    const { play, status } = this.parts;
    play.textContent = this.playing ? "Pause" : "Play";
    play.title = this.playing ? "pause" : "play";
    play.setAttribute("aria-label", play.title);
    status.setAttribute("aria-live", this.playing ? "off" : "polite");
  }

  stepBy(steps) {
    this.pause();
    this.show(this.step + steps);
  }

  show(step) {
    if (!this.read) return;
    this.step = Math.min(Math.max(step, 0), this.flight.steps);
    this.parts.slider.value = this.step;
    this.describe();
    this.draw();
  }

  describe() {
    if (!this.read) return;
    const { slider, status, caption, arena, values } = this.parts;
    const [{ flight, read, step, cell }, last] = [this, this.flight.steps];
    const where = `step ${step} of ${last}`;
    const facts = `reward so far ${fixed(read.reward(step), 2)}, clearance ${fixed(read.clearance(step), 1)} px`;
    const did = step === last ? { goal: "goal reached" }[flight.ended] ?? flight.ended : `action: ${inWords(this.actions[read.action(step)])}`;
    status.textContent = `${where}: ${facts}, ${did}`;
    slider.setAttribute("aria-valuetext", where);
    caption.textContent = `${cell.values} of each action (the chosen one is framed)`;
    arena.setAttribute("aria-label", `The ${this.world.depth ? "box" : "arena"} at ${where}, seen from above${this.world.depth ? " and from the side" : ""}`);
    const range = step === last ? "none" : `from ${short(read.low(step))} to ${short(read.high(step))}`;
    values.setAttribute("aria-label", `${cell.values} of the ${this.actions.length} actions: ${range}`);
  }

  draw() {
    if (!this.read) return;
    const { read, step, colours, font, grid, flight, world } = this;
    const over = step === flight.steps;
    const drone = { ...droneAt(world, read, step), crashed: crashedAt(flight, step) };
    const scene = { world, ...around(this.data, this.cell, flight, step), colours };
    if (world.depth) drawBox(this.parts.arena, { ...scene, drone, font });
    else drawArena(this.parts.arena, { ...scene, drones: [drone] });
    const values = over
      ? { instead: "the flight is over" }
      : { shares: (action) => read.value(step, action), chosen: read.action(step), low: read.low(step), high: read.high(step) };
    drawValues(this.parts.values, { grid, colours, font, ...values });
  }
}

/** Build the player inside an element; with no flights it says so. */
function startReplays(root, data) {
  if (data.cells.length) new Player(root, data);
  else make(root, "p", { className: "replay-status", textContent: "There is no policy whose flight could be shown." });
}
