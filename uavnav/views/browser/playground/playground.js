/*
 * The page: new Playground(data) brings the race, the arena, the instruments and the controls together.
 *
 * `data` is what __init__.py writes: constants of the tasks, their layouts and settings, metrics, colours and
 * policies. In the page, an element with `data-scene` shows a part of the scene and changes it.
 */

const ADDRESS = 200; // [ms] from a change of the scene to the address that contains it
const WAYS_TO_END = { collision: "crashed", goal: "arrived", "time-out": "flew to the time limit" };
const OTHER_LAYOUT = { circles: null };
const RANDOM_LAYOUT = { layouts: RANDOM, circles: null };
const ALSO = {
  k: RANDOM_LAYOUT, gap: RANDOM_LAYOUT, pace: { layouts: RANDOM },
  layouts: OTHER_LAYOUT, layout: OTHER_LAYOUT,
};

class Playground extends Playing {
  constructor(data) {
    super();
    this.data = data;
    this.find = (id) => document.getElementById(id);
    this.read = readers(data.settings, data.tasks.drone.world);
    this.race = new Race(data, data.scene);
    this.stage = new Stage(this, this.find("stage"));
    this.panel = new Panel(data, this.find);
    this.rows = []; // of a person's finished episodes that are not kept yet
    this.share = 1; // of the way from the last poses to these
    this.keyboard = new Keyboard(this);
    this.listenTo(document);
    this.controls = [...document.querySelectorAll("[data-scene]")];
    for (const control of this.controls) {
      const { id, type } = control;
      const text = () => (type === "checkbox" ? (control.checked ? "yes" : "no") : control.value);
      control.addEventListener(type === "range" ? "input" : "change", () => this.set(id, text()));
    }
    this.find("pilot").addEventListener("change", ({ target }) => this.handTo(this.focus, target.value));
    addEventListener("hashchange", () => this.open());
    watchLooks(document.body, () => this.show());
    this.open();
  }

  get world() { return this.race.task.world; }

  get scene() { return this.race.scene; }

  get focus() { return this.scene.focus - 1; }

  /** The scene that the address names; what is wrong in it is told. */
  open() {
    clearTimeout(this.later);
    this.playing = false;
    const [parts, wrong] = readLink(location.hash, this.read);
    this.load({ ...this.data.scene, ...parts });
    if (parts.circles && !this.race.circlesFit()) this.load({ ...this.scene, circles: null });
    wrong.push(...Object.keys(parts).filter((name) => parts[name] !== this.scene[name])); // not of this task
    this.focusOnFlyer();
    this.tell(wrong.length ? `Left out of the link, because it is not right: ${wrong.join(", ")}.` : "");
    this.showScene();
    this.show();
  }

  /** Begin a scene from its start; nothing that was tapped or held before counts. */
  load(scene) {
    this.race.load(scene);
    this.share = 1;
    this.keyboard.tapped.clear();
    this.stage.select(-1);
  }

  /** The scene into the address. */
  write() {
    const address = `#${writeLink(this.scene, this.data.settings)}`;
    if (location.hash !== address) history.replaceState(null, "", address);
  }

  async copy() {
    this.write();
    try {
      await navigator.clipboard.writeText(location.href);
      this.tell("The link to this scene is copied.");
    } catch {
      this.tell(`The link to this scene: ${location.href}`);
    }
  }

  tell(words) { say(this.find("notice"), words); }

  /** The person steers: the first key or touch begins the race, and brings that drone into focus. */
  begin() {
    const { race } = this;
    if (!race.yours || race.yours.ended) return;
    const still = race.steps === 0 || !race.flying().length; // time stands, and nobody stopped it
    if (!race.begun) this.focusOn(race.yours.place + 1);
    race.begin();
    if (still && !this.playing) this.start();
  }

  /** Change parts of the scene; from the start: everyone begins again. */
  change(parts, fromTheStart = false) {
    if (fromTheStart) {
      if (this.race.begun) this.playing = false; // who flies begins with a key
      this.load({ ...this.scene, ...parts });
    } else Object.assign(this.scene, parts);
    this.changed();
  }

  /** Show the scene, and keep it in the address soon: browsers slow down pages that change it too often. */
  changed() {
    clearTimeout(this.later);
    this.later = setTimeout(() => this.write(), ADDRESS);
    this.tell("");
    this.showScene();
    this.show();
  }

  /** Change one part of the scene to what a control says. */
  set(name, text) {
    const value = this.read[name](text);
    if (value === undefined) return this.changed();
    if (name === "greedy") this.race.greedy(value);
    if (name === "task") return this.enter(value);
    return this.change({ [name]: value, ...ALSO[name] }, name !== "speed" && name !== "greedy");
  }

  /** Another task, its obstacles its own; whoever cannot fly there waits. */
  enter(task) {
    if (this.stage.drawing) this.draw();
    const [layouts = RANDOM] = Object.keys(this.data.layouts[task] ?? {});
    this.change({ task, layouts, circles: null }, true);
    this.focusOnFlyer();
    this.changed();
  }

  /** Where the drone in focus is none of those in the race, or of those given, the first of them is. */
  focusOnFlyer(drones = this.race.piloted) {
    const isAmong = drones.includes(this.race.drones[this.focus]);
    if (drones.length && !isAmong) this.scene.focus = drones[0].place + 1;
  }

  again() { this.change({}, true); }

  /** How many layouts there are of the kind that is shown. */
  get count() {
    const { task, layouts } = this.scene;
    return this.data.layouts[task]?.[layouts]?.length ?? LAST_NUMBER + 1;
  }

  /** Another layout, so many further on, counted round and round. */
  next(more) {
    this.set("layout", String((this.scene.layout + more + this.count) % this.count));
  }

  /** Faster or slower; while drawing, the circle larger or smaller. */
  scale(by) {
    if (this.stage.drawing) return this.alter(0, 0, by * STRIDE.size);
    const { options, selectedIndex } = this.find("speed");
    return this.set("speed", options[clamp(selectedIndex + by, 0, options.length - 1)].value);
  }

  focusOn(focus) { this.change({ focus }); }

  handTo(place, pilot) {
    if (pilot === YOU) {
      const { state, last } = this.race.drones[place];
      this.race.hand = [0, clamp(state.distance - last.distance, 0, this.world.n_distances - 1)];
    }
    this.race.handTo(place, pilot);
    this.changed();
  }

  /** Fly the drone in focus by hand, or hand it back. */
  take() {
    const mine = this.scene.pilots[this.focus] === YOU;
    this.handTo(this.focus, mine ? this.race.drones[this.focus].before : YOU);
    this.find("stage").focus({ preventScroll: true });
  }

  nextPolicy() {
    const keys = this.data.policies.map(({ key }) => key).filter((key) => this.race.canFly(key));
    const next = keys.indexOf(this.scene.pilots[this.focus]) + 1;
    if (keys.length) this.handTo(this.focus, keys[next % keys.length]);
  }

  /** Begin to draw obstacles, or fly again. */
  draw() {
    const { stage, race } = this;
    stage.drawing = !stage.drawing;
    if (stage.drawing && race.task.moves) {
      this.pause(); // what is drawn is where circles start
      this.again();
    }
    stage.select(stage.drawing && race.circles.length ? 0 : -1);
    document.body.classList.toggle("drawing", stage.drawing);
    this.find("draw").setAttribute("aria-pressed", String(stage.drawing));
    this.show();
  }

  /** Other circles, while everyone flies on. selected: one of them. */
  edit(circles, selected) {
    this.race.replaceCircles(circles);
    this.scene.circles = circles;
    this.stage.selected = selected;
    this.changed();
  }

  /** A new circle, selected; false where it cannot be. */
  add(circle) {
    const { circles, free } = this.race;
    const there = circle && allowed(this.world, circle, free);
    if (circles.length < MOST_CIRCLES && there) this.edit([...circles, there], circles.length);
    else if (there) this.tell(`${MOST_CIRCLES} obstacles are the most.`);
    else this.tell(`Not there: the start${this.race.layout.goal ? " and the goal" : ""} must stay free.`);
    return this.race.circles.length > circles.length;
  }

  /** A new circle somewhere, for those who do not point. */
  addFree() {
    if (!this.stage.drawing) return;
    const { circles, free } = this.race;
    const some = generate(this.world, 100, this.scene.layout + 1000 * (circles.length + 1));
    const isNew = ([x, y]) => circles.every((other) => Math.hypot(other[0] - x, other[1] - y) > 1);
    this.add(some.find((circle) => isNew(circle) && allowed(this.world, circle, free)));
  }

  select(by) {
    const count = this.race.circles.length;
    if (!this.stage.drawing || !count) return;
    const from = this.stage.selected < 0 && by < 0 ? 0 : this.stage.selected;
    this.stage.select((from + by + count) % count);
    this.show();
  }

  /** Move the selected circle, or change its radius, by so many px. */
  alter(dx, dy, larger) {
    const circle = this.race.circles[this.stage.selected];
    if (circle) this.stage.change([circle[0] + dx, circle[1] + dy, circle[2] + larger]);
  }

  remove() {
    const { selected } = this.stage;
    if (!this.stage.drawing || !this.race.circles[selected]) return;
    const circles = this.race.circles.toSpliced(selected, 1);
    this.edit(circles, Math.min(selected, circles.length - 1));
    this.stage.held = null; // it has another circle now
  }

  clear() { this.edit([], -1); }

  /** Save the episodes that a person flew, with those that this browser kept before. */
  keep() {
    const count = this.rows.length && keepRows(this.data.columns, this.rows);
    const none = "There is no new episode to keep: fly one on a test layout of the paper's task to its end.";
    const kept = `human.csv has your episodes: ${count}. For a report: uavnav play --keep human.csv`;
    this.rows = [];
    this.tell(count ? kept : none);
    this.show();
  }

  /** Save the obstacles as a layout file. */
  async saveLayout() {
    const { layout, scene } = this.race;
    const isRight = layout.circles.length && !layout.goal;
    if (isRight) await saveRows(layout.circles, this.data.headers[scene.task]);
    this.tell(isRight
      ? "own.safetensors has these obstacles: uavnav play --layouts own.safetensors"
      : "Only layouts with obstacles and without a goal can be saved.");
  }

  start() {
    if (!this.race.flying().length && this.race.steps) this.again();
    if (!this.fly()) return;
    if (!this.race.begun) this.focusOnFlyer(this.race.flying());
    this.play();
  }

  /** Whether anyone flies in the next step. Among circles that move nobody draws while time goes. */
  fly() {
    const { race, stage } = this;
    if (stage.drawing && race.task.moves) this.draw();
    if (!race.flying().length && !race.steps) race.begin(); // nobody else is in the race
    return race.flying().length > 0;
  }

  pause() {
    this.playing = false;
    this.share = 1;
    this.show();
  }

  oneStep() {
    this.playing = false;
    if (this.fly()) this.advance();
    this.pause();
    this.describe();
  }

  /** What belongs to one picture: the steps that are due in so many seconds, and drawing. */
  frame(seconds) {
    this.share += seconds * STEPS_PER_SECOND * this.scene.speed;
    while (this.share > 1 && this.playing) {
      this.share -= 1;
      this.advance();
    }
    this.show();
  }

  /** One step, in which a person steers by the pointer or by keys. */
  advance() {
    const { race: { yours }, stage: { target } } = this;
    this.race.hand = target && yours ? towards(this.world, yours.state, target) : this.keyboard.hand();
    const ended = this.race.step();
    this.rows.push(...ended.map((drone) => rowOf(this.race, drone, this.data.limit)).filter(Boolean));
    if (ended.length) {
      this.describe();
      this.show();
    }
    if (!this.race.flying().length) this.pause();
  }

  /** The colour of each drone's pilot. */
  get pilots() {
    const { data: { policies, colours }, race: { drones } } = this;
    const ink = readColours(document.body).fg;
    return coloursOf(drones.map(({ pilot }) => pilot), policies, colours, ink);
  }

  /** Everything but the scene's own controls. */
  show() {
    const { race, panel, pilots } = this;
    this.stage.draw(this.share, this.focus);
    panel.showRace(race, this.focus, pilots);
    panel.showDrone(race, this.focus, pilots[this.focus]);
    this.showPilot();
    this.showWorld();
    this.showBanner();
  }

  /** The scene's own controls: only when it changes, for a number may be half typed. */
  showScene() {
    this.find("layout").max = this.count - 1;
    for (const control of this.controls) {
      if (control.type === "checkbox") control.checked = this.scene[control.id];
      else control.value = this.scene[control.id];
    }
  }

  /** Who flies the drone in focus, or will from the next start, and how a person steers. */
  showPilot() {
    const { race, scene, find } = this;
    const next = scene.pilots[this.focus];
    const waits = "This drone's episode has ended: the next start hands it over. ";
    say(find("take"), next === YOU ? `Hand drone ${scene.focus} back` : `Fly drone ${scene.focus}`);
    say(find("focus-number"), String(scene.focus));
    say(find("steering"), race.yours
      ? `Drone ${race.yours.place + 1} is yours: arrow keys, or hold mouse or finger where it shall fly.`
      : "To fly by hand, choose a drone and take it.");
    const ended = next === race.drones[this.focus].pilot ? "" : waits;
    say(find("acts"), `${ended}${race.policyOf(next)?.told ?? ""}`);
    for (const option of find("pilot").options) {
      option.selected = option.value === next;
      option.disabled = option.value !== NOBODY && !race.canFly(option.value);
    }
  }

  /** The task with its layouts, sliders and faults. */
  showWorld() {
    const { race, scene, find } = this;
    const { settings, policies, about, layouts } = this.data;
    const has = (name) => name === RANDOM || name in (layouts[scene.task] ?? {});
    for (const option of find("layouts").options) option.disabled = !has(option.value);
    find("they-move").hidden = !race.task.moves;
    find("k").value = race.circles.length;
    find("k").disabled = this.stage.drawing;
    say(find("k-now"), String(race.circles.length));
    for (const [name, { unit }] of Object.entries(settings)) {
      say(find(`${name}-now`), `${short(scene[name])}${unit && ` ${unit}`}`);
    }
    const faults = Object.keys(NO_FAULTS).filter((name) => scene[name] > 0);
    say(find("faults-now"), faults.map((name) => `${name} ${short(scene[name])}`).join(", ") || "none");
    const able = !policies.length || policies.some(({ key }) => race.canFly(key));
    const told = able ? "" : " No network here has learned that: you and the scripted policy fly.";
    say(find("told"), `${about[scene.task].told}${told}`);
  }

  /** Over the arena: how to begin, or how it ended and what one can do next. */
  showBanner() {
    const { race, find } = this;
    const mine = race.yours;
    const atStart = !this.playing && race.steps === 0;
    const over = race.steps > 0 && !race.flying().length;
    const crashed = race.piloted.every(({ ended }) => ended === "collision");
    const told = mine && `step ${mine.state.steps}, reward ${fixed(mine.state.reward, 1)}`;
    let words = "";
    if (atStart) words = mine ? "Press an arrow key to fly, Space to watch." : "Press Space to watch.";
    else if (mine?.ended) words = `You ${WAYS_TO_END[mine.ended]}: ${told}.`;
    else if (over) words = crashed ? "All have crashed." : "The race is over.";
    find("banner").hidden = !words || this.stage.drawing || !race.piloted.length;
    say(find("banner-words"), words);
    find("banner-touch").hidden = !atStart || !mine;
    find("banner-next").parentElement.hidden = atStart;
    find("banner-keep").hidden = !this.rows.length;
  }

  /** Words for those who do not see the arena: after a step, and when an episode ends. */
  describe() {
    const flying = this.race.flying();
    const words = this.race.piloted.map((drone) => {
      const { place, pilot, state, ended } = drone;
      const [who, more] = nameOf(pilot, this.data.policies);
      const how = ended ? ENDS[ended] : flying.includes(drone) ? "flies" : "waits";
      return `${place + 1}, ${who} ${more}: ${how}, step ${state.steps}, reward ${fixed(state.reward, 1)}.`;
    });
    say(this.find("status"), words.join(" "));
  }
}
