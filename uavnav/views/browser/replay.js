/*
 * The player of recorded episodes: new Player(root, data) shows it, which is the template inside an element.
 *
 * `data` is what uavnav/views/replays.py records; drawing.js draws it, and box.js says what is seen of what
 * is in 3D. Nothing moves before the reader asks for it.
 */

const TYPES = {
  uint8: Uint8Array, int8: Int8Array, uint16: Uint16Array, int16: Int16Array, float32: Float32Array,
}; // of a field; bytes are little-endian, as those of every browser are

/** The fields of an episode by name: each a function of the step (and the column) that gives the number. */
async function unpack(episode, fields) {
  const packed = new Blob([bytesOf(episode.bytes)]).stream();
  const bytes = await new Response(packed.pipeThrough(new DecompressionStream("deflate"))).arrayBuffer();
  const read = {};
  let start = 0;
  for (const { name, type, unit, chosen, columns } of fields) {
    const rows = episode.steps + (chosen ? 0 : 1); // the last pose chooses nothing
    const end = start + rows * columns * TYPES[type].BYTES_PER_ELEMENT;
    const numbers = new TYPES[type](bytes.slice(start, end));
    read[name] = (step, column = 0) => numbers[column * rows + step] * unit;
    start = end;
  }
  return read;
}

/** What stands around an episode at a step: { circles, goal }. */
function around({ layouts }, { place }, { layout }, step) {
  if (!place) return { circles: layouts[layout] };
  const shown = place.layouts[layout];
  if (place.world.depth) return { spheres: spheresAt(place.world, shown.circles, step) };
  return { circles: new TASKS[place.task](place).obstacles(shown, step), goal: shown.goal };
}

/**
 * A drone as drawArena or viewOf takes it: where it is at a step, what it senses, the trail of so many steps.
 * read: of an episode, as `unpack` gives it.
 */
function droneAt(world, episode, read, step, trail = Infinity) {
  const has = (name) => name in read; // a box has more
  const place = (at) => ["x", "y", "z"].filter(has).map((axis) => read[axis](at));
  const [here, angle] = [place(step), radians(read.heading(step))];
  const names = ["right", "up", "forward", "proximity"].filter(has);
  const slotAt = (_, slot) => names.map((name) => read[name](step, slot));
  const slots = Array.from({ length: world.n_slots }, slotAt);
  const first = Math.max(0, step - trail);
  const places = Array.from({ length: step - first + 1 }, (_, at) => place(first + at));
  const axes = has("pitch") ? bodyAxes({ yaw: angle, pitch: radians(read.pitch(step)) }) : planeAxes(angle);
  const pose = { x: here[0], y: here[1], angle };
  const crashed = step === episode.steps && episode.ended === "collision";
  return { pose, place: here, axes, trail: places, sensed: sensedPoints(world, here, axes, slots), crashed };
}

/** Give a select its choices [value, text], and keep what was chosen if it is still there. */
function fill(select, choices, wanted = select.value) {
  select.replaceChildren(...choices.map(([value, text]) => new Option(text, value)));
  if (choices.some(([value]) => String(value) === String(wanted))) select.value = wanted;
}

class Player extends Playing {
  constructor(root, data) {
    super();
    this.data = data;
    root.player = this;
    root.replaceChildren(root.querySelector("template").content);
    const parts = [...root.querySelectorAll("[data-part]")];
    this.parts = Object.fromEntries(parts.map((part) => [part.dataset.part, part]));
    this.step = 0;
    fill(this.parts.configuration, data.configurations.map(({ name }, place) => [place, name]));
    const { player, configuration, seed, layout, slider } = this.parts;
    this.listenTo(player);
    for (const list of [configuration, seed, layout]) list.addEventListener("change", () => this.choose());
    slider.addEventListener("input", () => this.show(Number(slider.value)));
    watchLooks(player, () => this.draw());
    this.choose();
  }

  /** Where the reader is, as `open` takes it. */
  get bookmark() {
    const { seed, layout, speed } = this.parts;
    const { name } = this.configuration;
    return { name, seed: seed.value, layout: layout.value, speed: speed.value, step: this.step };
  }

  /** Go where a bookmark of an earlier page says, if its configuration is still there. */
  open({ name, seed, layout, speed, step }) {
    const place = this.data.configurations.findIndex((one) => one.name === name);
    if (place < 0) return;
    this.parts.configuration.value = place;
    this.parts.speed.value = speed;
    this.choose({ seed, layout, step });
  }

  /** Show the chosen episode; what stays of a list's choices stays chosen. wanted: what else shall be. */
  async choose({ seed, layout, step = 0 } = {}) {
    const { parts } = this;
    this.pause();
    this.configuration = this.data.configurations[parts.configuration.value];
    const { episodes, place = this.data } = this.configuration;
    this.place = place;
    fill(parts.seed, [...new Set(episodes.map((one) => one.seed))].map((one) => [one, one]), seed);
    const own = episodes.filter((one) => one.seed === Number(parts.seed.value));
    const words = (one) => `${one.layout + 1} (${one.ended} at ${one.steps})`;
    fill(parts.layout, own.map((one) => [one.layout, words(one)]), layout);
    this.episode = own.find((one) => one.layout === Number(parts.layout.value));
    parts.values.innerHTML = place.values;
    parts.views.classList.toggle("in-3d", Boolean(place.world.depth));
    parts.views.style.setProperty("--accent", this.configuration.accent ?? "");
    this.read = null; // its fields, once it is unpacked
    parts.status.textContent = "unpacking the episode …";
    const unpacking = (this.unpacking = unpack(this.episode, place.fields));
    try {
      const read = await unpacking;
      if (this.unpacking !== unpacking) return; // another was chosen meanwhile
      this.read = read;
      parts.slider.max = this.episode.steps;
      this.show(step);
    } catch ({ message }) {
      if (this.unpacking !== unpacking) return;
      parts.status.textContent = `This episode cannot be shown in this browser (${message}).`;
    }
  }

  start() {
    if (!this.read) return;
    this.parts.status.ariaLive = "off"; // not read out while they change all the time
    if (this.step === this.episode.steps) this.show(0);
    this.due = 0; // steps of the next picture, whole and parts
    this.play();
  }

  frame(seconds) {
    this.due += seconds * STEPS_PER_SECOND * Number(this.parts.speed.value);
    const whole = Math.floor(this.due);
    this.due -= whole;
    if (whole) this.show(this.step + whole);
    if (this.step === this.episode.steps) this.pause();
  }

  pause() {
    const played = this.playing;
    this.playing = false;
    this.parts.status.ariaLive = "polite";
    if (played) this.describe(); // once more, now that changes are read out
  }

  stepBy(steps) {
    this.pause();
    this.show(this.step + steps);
  }

  show(step) {
    if (!this.read) return;
    this.step = clamp(step, 0, this.episode.steps);
    this.parts.slider.value = this.step;
    this.describe();
    this.draw();
  }

  describe() {
    const { slider, status, caption, arena, side, values } = this.parts;
    const [{ episode, read, step, configuration }, last] = [this, this.episode.steps];
    const { world, actions } = this.place;
    const where = `step ${step} of ${last}`;
    const [reward, clearance] = [fixed(read.reward(step), 2), fixed(read.clearance(step), 1)];
    const ended = episode.ended === "goal" ? "goal reached" : episode.ended;
    const did = step === last ? ended : `action: ${inWords(actions[read.action(step)])}`;
    status.textContent = `${where}: reward so far ${reward}, clearance ${clearance} px, ${did}`;
    slider.setAttribute("aria-valuetext", where);
    caption.textContent = `${configuration.values} of each action (the chosen one is framed)`;
    arena.setAttribute("aria-label", `The ${world.depth ? "box" : "arena"} at ${where}, seen from above`);
    side.setAttribute("aria-label", `The box at ${where}, seen from the side`);
    const range = step === last ? "none" : `from ${short(read.low(step))} to ${short(read.high(step))}`;
    values.setAttribute("aria-label", `${configuration.values} of the ${actions.length} actions: ${range}`);
  }

  draw() {
    if (!this.read) return;
    const { read, step, episode, place: { world } } = this;
    const { arena, side, values } = this.parts;
    const drone = droneAt(world, episode, read, step);
    const scene = { world, ...around(this.data, this.configuration, episode, step) };
    const look = (canvas, nth) => drawArena(canvas, viewOf(VIEWS[nth], { ...scene, drone }));
    if (world.depth) [arena, side].forEach(look);
    else drawArena(arena, { ...scene, drones: [drone] });
    if (step === episode.steps) showValues(values, { instead: "the episode is over" });
    else {
      const shares = (action) => read.value(step, action);
      showValues(values, { shares, chosen: read.action(step), low: read.low(step), high: read.high(step) });
    }
  }
}
