/*
 * The page: startPlayground(data) brings the race, the arena, the instruments and the controls together.
 *
 * `data` is what __init__.py writes: constants of the worlds, their settings, metrics and policies.
 */

const MOST_AT_ONCE = 8; // steps from one picture to the next
const ADDRESS = 200; // [ms] from a change of the scene to the address that holds it
const INSTRUMENTS = 0.066; // [s] from one picture of the instruments to the next

class Playground {
  constructor(data) {
    this.data = data;
    this.find = (id) => document.getElementById(id);
    this.known = [YOU, RULE, NOBODY, ...data.policies.map(({ key }) => key)];
    this.race = new Race(data.tasks, data.policies, this.first());
    this.stage = new Stage(this, this.find("stage"));
    this.panel = new Panel(data, this.find);
    this.playing = false;
    this.share = 1; // of the way from the last poses to these
    this.keyboard = new Keyboard(this);
    this.build();
    this.listen();
    this.open();
    if (!matchMedia("(prefers-reduced-motion: reduce)").matches && this.race.flying().length) this.start();
  }

  first() {
    return firstScene(this.data);
  }

  get world() {
    return this.race.world;
  }

  get scene() {
    return this.race.scene;
  }

  get focus() {
    return this.scene.focus - 1;
  }

  // -------------------------------------------------------------------------------------------- links

  /** The scene that the address names; what is wrong in it is told. */
  open() {
    clearTimeout(this.later);
    const [parts, wrong] = readLink(location.hash, this.world, this.known, this.data.settings);
    const first = location.hash.length > 1 ? { ...this.first(), world: "drone" } : this.first(); // unless a link says it
    this.race.load({ ...first, ...parts });
    if (parts.circles && !this.race.circlesFit()) {
      wrong.push("circles");
      this.race.load({ ...this.scene, circles: null });
    }
    this.focusOnFlyer();
    this.tell(wrong.length ? `Left out of the link, because it is not right: ${wrong.join(", ")}.` : "");
    this.share = 1;
    this.showControls();
    this.show();
  }

  /** Keep the scene in the address, soon: browsers slow down pages that change it at every move of a slider. */
  keep() {
    clearTimeout(this.later);
    this.later = setTimeout(() => this.write(), ADDRESS);
  }

  write() {
    const circles = this.scene.circles ? this.race.circles : null;
    const address = `#${writeLink({ ...this.scene, circles }, this.data.settings)}`;
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

  tell(words) {
    const notice = this.find("notice");
    notice.textContent = words;
    notice.hidden = !words;
  }

  // -------------------------------------------------------------------------------------------- controls

  build() {
    const { policies } = this.data;
    const speeds = SPEEDS.map((speed) => new Option(`${speed}×`, speed));
    this.find("speed").replaceChildren(...speeds);
    const groups = [...new Set(policies.map(({ algorithm }) => algorithm))].map((algorithm) => {
      const group = document.createElement("optgroup");
      group.label = algorithm.toUpperCase();
      const mine = policies.filter((policy) => policy.algorithm === algorithm);
      group.append(...mine.map(({ key, title }) => new Option(title, key)));
      return group;
    });
    this.find("pilot").append(new Option("you", YOU), new Option("the rule", RULE), new Option("nobody", NOBODY), ...groups);
    this.find("keys").append(
      ...KEYS.map(([keys, does]) => {
        const row = document.createElement("tr");
        const head = row.appendChild(document.createElement("th"));
        head.scope = "row";
        head.textContent = keys;
        row.appendChild(document.createElement("td")).textContent = does;
        return row;
      }),
    );
  }

  listen() {
    const on = (id, name, act) => this.find(id).addEventListener(name, (event) => act(event.target));
    const clicks = {
      play: () => this.toggle(), "one-step": () => this.oneStep(), again: () => this.again(), take: () => this.take(),
      next: () => this.setOf(1), draw: () => this.draw(!this.stage.drawing), copy: () => this.copy(),
      add: () => this.addFree(), smaller: () => this.alter(0, 0, -STRIDE.size), larger: () => this.alter(0, 0, STRIDE.size),
      remove: () => this.remove(), clear: () => this.clear(),
    };
    for (const [id, act] of Object.entries(clicks)) on(id, "click", act);
    on("speed", "change", ({ value }) => this.change({ speed: Number(value) }));
    on("k", "input", ({ value }) => this.change({ k: Number(value), circles: null }, true));
    on("world", "change", ({ value }) => this.enter(value));
    for (const name of Object.keys(this.data.settings)) {
      on(name, "input", ({ value }) => this.change({ [name]: Number(value), ...(name === "gap" ? { circles: null } : {}) }, true));
    }
    on("seed", "change", ({ value }) => this.change({ seed: READ.seed(value) ?? this.scene.seed }, true));
    on("pilot", "change", ({ value }) => this.handTo(this.focus, value));
    on("greedy", "change", ({ checked }) => {
      this.race.greedy(checked);
      this.changed();
    });
    this.panel.seats.forEach((seat, place) => seat.addEventListener("click", () => this.focusOn(place)));
    addEventListener("hashchange", () => this.open());
    watchLooks(document.body, () => this.show(), () => this.recolour());
  }

  /** What the pointer or the keys steer in the next step. */
  steer() {
    const yours = this.race.drones.find(({ pilot }) => pilot === YOU);
    const { target } = this.stage;
    this.race.hand = target && yours ? towards(this.world, yours.state, target) : this.keyboard.hand();
  }

  /** Change parts of the scene; from the start: everyone begins again. */
  change(parts, fromTheStart = false) {
    if (fromTheStart) {
      const drawn = this.scene.circles ? this.race.circles : null;
      this.race.load({ ...this.scene, circles: drawn, ...parts });
      this.share = 1;
      this.stage.selected = -1;
    } else Object.assign(this.scene, parts);
    this.changed();
  }

  changed() {
    this.keep();
    this.showControls();
    this.show();
  }

  /** Another world, its obstacles its own; whoever cannot fly there waits. */
  enter(world) {
    if (this.stage.drawing) this.draw(false);
    this.change({ world, circles: null }, true);
    this.focusOnFlyer();
    this.changed();
  }

  /** Where the drone in focus cannot fly, the first that can is in focus. */
  focusOnFlyer() {
    const first = this.race.drones.findIndex(({ pilot }) => this.race.canFly(pilot));
    if (!this.race.canFly(this.race.drones[this.focus].pilot) && first >= 0) this.scene.focus = first + 1;
  }

  again() {
    this.change({}, true);
  }

  setOf(more) {
    this.change({ set: Math.max(0, this.scene.set + more), circles: null }, true);
  }

  paced(by) {
    const place = clamp(SPEEDS.indexOf(this.scene.speed) + by, 0, SPEEDS.length - 1);
    this.change({ speed: SPEEDS[place] });
  }

  focusOn(place) {
    this.change({ focus: place + 1 });
  }

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
    const drone = this.race.drones[this.focus];
    this.handTo(this.focus, drone.pilot === YOU ? drone.before : YOU);
    this.find("stage").focus({ preventScroll: true });
  }

  nextPolicy() {
    const keys = this.data.policies.map(({ key }) => key).filter((key) => this.race.canFly(key));
    if (keys.length) this.handTo(this.focus, keys[(keys.indexOf(this.race.drones[this.focus].pilot) + 1) % keys.length]);
  }

  // -------------------------------------------------------------------------------------------- drawn obstacles

  draw(on) {
    if (on && this.race.task.moves) {
      this.pause(); // what is drawn is where circles start
      this.again();
    }
    this.stage.drawing = on;
    this.stage.selected = on && this.race.circles.length ? 0 : -1;
    document.body.classList.toggle("drawing", on);
    this.showControls();
    this.show();
  }

  /** Other circles, while everyone flies on. */
  edit(circles) {
    this.race.replaceCircles(circles);
    this.scene.circles = circles;
    this.show();
  }

  /** A new circle, selected; false where there are too many. */
  add(circle) {
    const { circles } = this.race;
    if (circles.length >= MOST_CIRCLES) {
      this.tell(`${MOST_CIRCLES} obstacles are the most.`);
      return false;
    }
    this.edit([...circles, allowed(this.world, circle, this.race.free)]);
    this.stage.selected = circles.length;
    return true;
  }

  /** A new circle somewhere, for those who do not point. */
  addFree() {
    const [circle] = generate(this.world, 1, this.scene.set + 1000 * (this.race.circles.length + 1));
    if (this.add(circle)) this.changed();
  }

  select(by) {
    const count = this.race.circles.length;
    if (!this.stage.drawing || !count) return;
    this.stage.selected = (this.stage.selected + by + count) % count;
    this.show();
  }

  /** Move the selected circle, or change its radius, by so many px. */
  alter(dx, dy, larger) {
    const circle = this.race.circles[this.stage.selected];
    if (!circle) return;
    this.stage.change([circle[0] + dx, circle[1] + dy, circle[2] + larger]);
    this.changed();
  }

  remove() {
    const { selected } = this.stage;
    if (!this.stage.drawing || !this.race.circles[selected]) return;
    this.edit(this.race.circles.toSpliced(selected, 1));
    this.stage.selected = Math.min(selected, this.race.circles.length - 1);
    this.changed();
  }

  clear() {
    this.edit([]);
    this.stage.selected = -1;
    this.changed();
  }

  // -------------------------------------------------------------------------------------------- time

  toggle() {
    if (this.playing) this.pause();
    else this.start();
  }

  start() {
    this.fly();
    if (!this.race.flying().length) this.again();
    if (!this.race.flying().length) return; // nobody is in the race
    this.playing = true;
    this.showControls();
    everyPicture(this, (seconds) => this.frame(seconds));
  }

  /** Among circles that move nobody draws while time goes. */
  fly() {
    if (this.stage.drawing && this.race.task.moves) this.draw(false);
  }

  pause() {
    this.playing = false;
    this.showControls();
    this.show();
  }

  oneStep() {
    this.playing = false;
    this.fly();
    if (this.race.flying().length) this.advance();
    this.share = 1;
    this.showControls();
    this.show();
    this.describe();
  }

  /** What belongs to one picture: the steps that are due in so many seconds, and drawing. */
  frame(seconds) {
    this.share += seconds * STEPS_PER_SECOND * this.scene.speed;
    for (let steps = 0; this.share > 1 && this.playing; steps += 1) {
      this.share = steps < MOST_AT_ONCE ? this.share - 1 : 1;
      if (steps < MOST_AT_ONCE) this.advance();
    }
    this.stage.draw(this.share, this.focus, this.colours);
    this.unseen = (this.unseen ?? 0) + seconds;
    if (this.playing && this.unseen > INSTRUMENTS) {
      this.unseen = 0;
      this.showInstruments();
    }
  }

  advance() {
    this.steer();
    const ended = this.race.step();
    if (ended.length) this.describe();
    if (this.race.flying().length) return;
    this.playing = false;
    this.share = 1;
    this.showControls();
    this.show();
  }

  // -------------------------------------------------------------------------------------------- what is shown

  /** The page's colours as they are now: those of its ground, and those of its cards. */
  recolour() {
    const names = [...COLOURS, ...this.race.drones.map((_, place) => `drone-${place + 1}`)];
    this.colours = readColours(this.stage.element, names);
    this.cardColours = readColours(document.querySelector("aside > section"), names);
    this.font = `12px ${getComputedStyle(document.body).fontFamily}`;
    this.show();
  }

  /** Everything that moves. */
  show() {
    this.stage.draw(this.share, this.focus, this.colours);
    this.showInstruments();
  }

  showInstruments() {
    this.panel.showRace(this.race);
    this.panel.showDrone(this.race, this.focus, this.cardColours, this.font);
  }

  showControls() {
    const { race, scene, stage, find } = this;
    const drone = race.drones[this.focus];
    const over = !race.flying().length;
    say(find("play"), this.playing ? "Pause" : "Play");
    find("speed").value = scene.speed;
    find("k").value = race.circles.length;
    find("k").disabled = stage.drawing;
    say(find("k-now"), String(race.circles.length));
    showWorld(this.data, race, find);
    find("draw").setAttribute("aria-pressed", String(stage.drawing));
    find("drawing").hidden = !stage.drawing;
    say(find("take"), drone.pilot === YOU ? `Hand drone ${scene.focus} back` : `Fly drone ${scene.focus}`);
    say(find("focus-number"), String(scene.focus));
    find("pilot").value = drone.pilot;
    find("greedy").checked = scene.greedy;
    find("seed").value = scene.seed;
    say(find("acts"), this.data.policies.find(({ key }) => key === drone.pilot)?.told ?? "");
    const yours = race.drones.findIndex(({ pilot }) => pilot === YOU) + 1;
    const steering = yours
      ? `Drone ${yours} is yours: arrow keys, or hold the mouse or a finger where it shall fly.`
      : "To fly by hand, choose a drone and take it.";
    const where = race.task.moves ? " They move when you play." : "";
    const drawing = `Drag on free ground for a new circle, inside one to move it, at its edge to size it.${where}`;
    say(find("hint"), stage.drawing ? drawing : `${steering} Space pauses.`);
    const banner = find("banner");
    const waiting = !this.playing && !stage.drawing;
    banner.hidden = !waiting || !(over || race.drones.every(({ state }) => state.steps === 0));
    const down = race.drones.every(({ pilot, ended }) => !race.canFly(pilot) || ended === "collision");
    const end = down ? "All are down." : "The race is over.";
    say(banner, over ? `${end} Again, or the next set?` : "Press Play, or Space.");
    this.panel.showSeats(race, this.focus);
  }

  /** Words for those who do not see the arena: after a step, and when a drone crashes. */
  describe() {
    const words = this.race.drones.map(({ pilot, state, ended }, place) => {
      const [who, more] = nameOf(pilot, this.data.policies);
      const how = ended ? ENDS[ended] : "flies";
      return !this.race.canFly(pilot) ? "" : `${place + 1}, ${who} ${more}: ${how}, step ${state.steps}, reward ${fixed(state.reward, 1)}.`;
    });
    say(this.find("status"), words.filter(Boolean).join(" "));
  }
}

function startPlayground(data) {
  return new Playground(data);
}
