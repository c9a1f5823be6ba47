/*
 * The player of recorded episodes: startReplays(root, data) builds it inside an element.
 *
 * `data` is what uavnav/views/replays.py records; drawing.js draws it, and box.js what is in 3D. Nothing moves before the reader asks for it.
 */

const SPEEDS = [0.25, 1, 4];
const TYPES = {
  uint8: [1, "getUint8"], int8: [1, "getInt8"], uint16: [2, "getUint16"], int16: [2, "getInt16"],
  float32: [4, "getFloat32"],
}; // of a field: its bytes, and what reads it

async function inflate(text) {
  const packed = Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Response(stream).arrayBuffer();
}

/** The fields of an episode by name: each a function of the step (and the column) that gives the number. */
async function unpack(episode, fields) {
  const view = new DataView(await inflate(episode.bytes));
  const read = {};
  let start = 0;
  for (const { name, type, unit, chosen, columns } of fields) {
    const [bytes, getter] = TYPES[type];
    const rows = episode.steps + (chosen ? 0 : 1); // the last pose chooses nothing
    const first = start;
    read[name] = (step, column = 0) => view[getter](first + bytes * (column * rows + step), true) * unit;
    start += bytes * rows * columns;
  }
  return read;
}

/** A configuration in words, and where it flies if that has a name. */
function named({ algorithm, label, mode, place }) {
  return [`${algorithm.toUpperCase()} ${label}`, mode, ...(place ? [place.title] : [])].join(", ");
}

/** What stands around an episode at a step: { circles, goal }. */
function around({ layouts }, { place }, { layout }, step) {
  if (!place) return { circles: layouts[layout] };
  const shown = place.layouts[layout];
  if (place.world.depth) return { spheres: spheresAt(place.world, shown.circles, step) };
  return { circles: new TASKS[place.task](place).obstacles(shown, step), goal: shown.goal };
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
  const axes = inBox ? bodyAxes({ yaw: angle, pitch: radians(read.pitch(step)) }) : planeAxes(angle);
  const pose = { x: here[0], y: here[1], angle };
  return { pose, place: here, axes, trail: flown, sensed: sensedPoints(world, here, axes, slots) };
}

function crashedAt(episode, step) {
  return step === episode.steps && episode.ended === "collision";
}

function ending(episode) {
  return `${episode.ended} at ${episode.steps}`;
}

const PLAYER = `
<div class="replay" tabindex="0" role="group" aria-label="Player of episodes. Space plays and pauses, left and right arrows step.">
<div class="replay-row">
<label class="replay-label"><span>policy</span><select data-part="configuration"></select></label>
<label class="replay-label"><span>seed</span><select data-part="seed"></select></label>
<label class="replay-label"><span>layout</span><select data-part="layout"></select></label>
</div>
<div class="replay-stage">
<div class="replay-arena"><canvas data-part="arena" role="img"></canvas></div>
<div class="replay-row replay-transport">
<button type="button" class="replay-button" data-part="back" title="one step back" aria-label="one step back">◀</button>
<button type="button" class="replay-button" data-part="play" title="play" aria-label="play">Play</button>
<button type="button" class="replay-button" data-part="forward" title="one step forward" aria-label="one step forward">▶</button>
<label class="replay-label"><span>speed</span><select data-part="speed"></select></label>
<label class="replay-label replay-slider"><span>step</span><input type="range" min="0" max="0" value="0" data-part="slider"></label>
</div>
<p class="replay-status" aria-live="polite" data-part="status"></p>
<figure class="replay-side"><figcaption data-part="caption"></figcaption><canvas data-part="values" role="img"></canvas></figure>
</div>
</div>`;

/** The player inside an element, and its parts by name. */
function build(root) {
  root.insertAdjacentHTML("beforeend", PLAYER);
  const player = root.lastElementChild;
  const parts = Array.from(player.querySelectorAll("[data-part]"), (part) => [part.dataset.part, part]);
  return { player, ...Object.fromEntries(parts) };
}

/** Give a select its choices [value, text], and keep what was chosen if it is still there. */
function fill(select, choices, wanted = select.value) {
  select.replaceChildren(...choices.map(([value, text]) => new Option(text, value)));
  if (choices.some(([value]) => String(value) === String(wanted))) select.value = wanted;
}

class Player {
  constructor(root, data) {
    this.data = data;
    this.parts = build(root);
    this.episode = null; // the one that is shown
    this.read = null; // its fields, once it is unpacked
    this.step = 0;
    this.playing = false;
    fill(this.parts.speed, SPEEDS.map((times) => [times, `${times}×`]), 1);
    fill(this.parts.configuration, data.configurations.map((one, place) => [place, named(one)]));
    this.listen();
    this.chooseCell();
  }

  listen() {
    const { player, configuration, seed, layout, back, play, forward, slider } = this.parts;
    configuration.addEventListener("change", () => this.chooseCell());
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
    if (event.key === " " && tagName !== "BUTTON") event.repeat || this.toggle();
    else if (step && tagName !== "INPUT") this.stepBy(step);
    else return;
    event.preventDefault();
  }

  /** Where the reader is, as `open` takes it. */
  get bookmark() {
    const { seed, layout, speed } = this.parts;
    const name = named(this.configuration);
    return { name, seed: seed.value, layout: layout.value, speed: speed.value, step: this.step };
  }

  /** Go where a bookmark of an earlier page says, if its configuration is still there. */
  open({ name, seed, layout, speed, step }) {
    const place = this.data.configurations.findIndex((one) => named(one) === name);
    if (place < 0) return;
    this.parts.configuration.value = place;
    this.parts.speed.value = speed;
    this.chooseCell(seed, layout, step);
  }

  chooseCell(wantedSeed, wantedLayout, step) {
    const episodes = this.data.configurations[this.parts.configuration.value].episodes;
    const seeds = [...new Set(episodes.map(({ seed }) => seed))];
    fill(this.parts.seed, seeds.map((seed) => [seed, seed]), wantedSeed);
    this.chooseSeed(wantedLayout, step);
  }

  chooseSeed(wantedLayout, step) {
    const { configuration, seed, layout } = this.parts;
    const episodes = this.data.configurations[configuration.value].episodes.filter((episode) => episode.seed === Number(seed.value));
    fill(layout, episodes.map((episode) => [episode.layout, `${episode.layout + 1} (${ending(episode)})`]), wantedLayout);
    this.load(step);
  }

  async load(step = 0) {
    const { configuration, seed, layout, slider, status } = this.parts;
    this.pause();
    this.configuration = this.data.configurations[configuration.value];
    this.world = this.configuration.place?.world ?? this.data.world;
    this.actions = this.configuration.place?.actions ?? this.data.actions;
    this.grid = gridOf(this.actions);
    this.parts.arena.style.aspectRatio = this.world.depth ? shapeOf(this.world) : this.world.width / this.world.height;
    const episode = this.configuration.episodes.find(
      (one) => one.seed === Number(seed.value) && one.layout === Number(layout.value),
    );
    this.episode = episode;
    this.read = null;
    status.textContent = "unpacking the episode …";
    const unpacking = (this.unpacking = unpack(episode, this.configuration.place?.fields ?? this.data.fields));
    try {
      const read = await unpacking;
      if (this.unpacking !== unpacking) return; // another was chosen meanwhile
      this.read = read;
      slider.max = episode.steps;
      this.show(step);
    } catch (error) {
      if (this.unpacking === unpacking) status.textContent = `This episode cannot be shown in this browser (${error.message}).`;
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
    if (this.step === this.episode.steps) this.show(0);
    let due = 0; // steps, whole and parts
    everyPicture(this, (seconds) => {
      due += seconds * STEPS_PER_SECOND * Number(this.parts.speed.value);
      const whole = Math.floor(due);
      due -= whole;
      if (whole) this.show(this.step + whole);
      if (this.step === this.episode.steps) this.pause();
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
    this.step = Math.min(Math.max(step, 0), this.episode.steps);
    this.parts.slider.value = this.step;
    this.describe();
    this.draw();
  }

  describe() {
    const { slider, status, caption, arena, values } = this.parts;
    const [{ episode, read, step, configuration }, last] = [this, this.episode.steps];
    const where = `step ${step} of ${last}`;
    const facts = `reward so far ${fixed(read.reward(step), 2)}, clearance ${fixed(read.clearance(step), 1)} px`;
    const did = step === last ? { goal: "goal reached" }[episode.ended] ?? episode.ended : `action: ${inWords(this.actions[read.action(step)])}`;
    status.textContent = `${where}: ${facts}, ${did}`;
    slider.setAttribute("aria-valuetext", where);
    caption.textContent = `${configuration.values} of each action (the chosen one is framed)`;
    arena.setAttribute("aria-label", `The ${this.world.depth ? "box" : "arena"} at ${where}, seen from above${this.world.depth ? " and from the side" : ""}`);
    const range = step === last ? "none" : `from ${short(read.low(step))} to ${short(read.high(step))}`;
    values.setAttribute("aria-label", `${configuration.values} of the ${this.actions.length} actions: ${range}`);
  }

  draw() {
    if (!this.read) return;
    const { read, step, font, grid, episode, world } = this;
    const colours = { ...this.colours, accent: this.configuration.accent ?? this.colours.accent };
    const over = step === episode.steps;
    const drone = { ...droneAt(world, read, step), crashed: crashedAt(episode, step) };
    const scene = { world, ...around(this.data, this.configuration, episode, step), colours };
    if (world.depth) drawBox(this.parts.arena, { ...scene, drone, font });
    else drawArena(this.parts.arena, { ...scene, drones: [drone] });
    const values = over
      ? { instead: "the episode is over" }
      : { shares: (action) => read.value(step, action), chosen: read.action(step), low: read.low(step), high: read.high(step) };
    drawValues(this.parts.values, { grid, colours, font, ...values });
  }
}

/** Build the player inside an element, as its `player`; with no episodes it says so. */
function startReplays(root, data) {
  if (data.configurations.length) root.player = new Player(root, data);
  else root.insertAdjacentHTML("beforeend", '<p class="replay-status">There is no policy whose episode could be shown.</p>');
}
