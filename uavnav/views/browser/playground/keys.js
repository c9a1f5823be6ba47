/*
 * The keyboard: every key with what it does, which the page's help shows too, and the arrow keys that steer.
 */

const STRIDE = { circle: 10, size: 5 }; // [px] that a key moves or sizes a drawn circle
const ARROWS = { ArrowLeft: "left", ArrowRight: "right", ArrowUp: "up", ArrowDown: "down", a: "left", d: "right", w: "up", s: "down" };
const WAYS = { left: [-1, 0], right: [1, 0], up: [0, 1], down: [0, -1] };

/** Every key: how the help shows it, what it does, and the keys' names with what they call; arrows are apart. */
const KEYS = [
  ["← → A D", "turn your drone 5° left, 4° right; with Shift 1°"],
  ["↑ ↓ W S", "a pixel a step faster, slower"],
  ["Space", "pause, go on", { " ": (app) => app.toggle() }],
  [".", "one step", { ".": (app) => app.oneStep() }],
  ["− +", "slower, faster; while drawing: the circle smaller, larger", {
    "-": (app) => (app.stage.drawing ? app.alter(0, 0, -STRIDE.size) : app.paced(-1)),
    "+": (app) => (app.stage.drawing ? app.alter(0, 0, STRIDE.size) : app.paced(1)),
    "=": (app) => (app.stage.drawing ? app.alter(0, 0, STRIDE.size) : app.paced(1)),
  }],
  ["R Enter", "start again on the same obstacles", { r: (app) => app.again(), enter: (app) => app.again() }],
  ["N P", "next layout, the layout before", { n: (app) => app.next(1), p: (app) => app.next(-1) }],
  ["1 … 4", "the drone in focus", Object.fromEntries([1, 2, 3, 4].map((n) => [n, (app) => app.focusOn(n)]))],
  ["T", "take the drone in focus, hand it back", { t: (app) => app.take() }],
  ["C", "hand it to the next policy", { c: (app) => app.nextPolicy() }],
  ["E", "draw obstacles; again: fly", { e: (app) => app.draw() }],
  ["O", "while drawing: a new circle", { o: (app) => app.stage.drawing && app.addFree() }],
  ["[ ]", "while drawing: select another circle, which the arrow keys move", {
    "[": (app) => app.select(-1),
    "]": (app) => app.select(1),
  }],
  ["Del", "while drawing: delete the circle", { delete: (app) => app.remove(), backspace: (app) => app.remove() }],
  ["B", "save these obstacles as a layout file", { b: (app) => app.saveLayout() }],
  ["K", "keep your finished episodes on the test layouts, as rows for a report", { k: (app) => app.keep() }],
];
const GRADUAL = new Set([".", "-", "+", "=", "n", "p", "[", "]"]); // these act again while they are held down
const BY_KEY = Object.assign({}, ...KEYS.map(([, , acts]) => acts ?? {}));

class Keyboard {
  /** app: the page. */
  constructor(app) {
    this.app = app;
    this.held = new Set(); // arrow keys that are down
    this.tapped = new Set(); // those that went down since the last step
    this.fine = false; // whether Shift was down
    document.addEventListener("keydown", (event) => this.press(event));
    document.addEventListener("keyup", ({ key }) => this.held.delete(ARROWS[key] ?? ARROWS[key.toLowerCase()]));
    addEventListener("blur", () => this.held.clear());
  }

  /** Keys work where nothing else uses them: a button has Space and Enter, a field or a list has all. */
  press(event) {
    const { stage } = this.app;
    const key = event.key.toLowerCase();
    const taken = event.target.closest("select, input") || (event.target.closest("button, summary") && [" ", "enter"].includes(key));
    if (taken || event.altKey || event.ctrlKey || event.metaKey) return;
    const arrow = ARROWS[event.key] ?? ARROWS[key];
    const act = BY_KEY[key];
    if (!arrow && !act) return;
    event.preventDefault();
    if (act) (event.repeat && !GRADUAL.has(key)) || act(this.app);
    else if (stage.drawing) {
      const [dx, dy] = WAYS[arrow].map((way) => way * (event.shiftKey ? 1 : STRIDE.circle));
      this.app.alter(dx, dy, 0);
    } else this.steer(arrow, event);
  }

  steer(arrow, { repeat, shiftKey }) {
    const { race, world } = this.app;
    const faster = WAYS[arrow][1];
    this.fine = shiftKey;
    this.app.begin();
    if (faster) race.hand = [0, clamp(race.hand[1] + faster, 0, world.n_distances - 1)];
    else if (!repeat) [this.held, this.tapped].forEach((keys) => keys.add(arrow));
  }

  /** The turn [degrees] and distance [px] of the next step: a key that was tapped since the last one counts once. */
  hand() {
    const { race, world } = this.app;
    const keys = new Set([...this.held, ...this.tapped]);
    const way = Number(keys.has("left")) - Number(keys.has("right"));
    const left = Math.floor(world.n_turns / 2);
    const most = way > 0 ? left : world.n_turns - left - 1;
    this.tapped.clear();
    return [way * (this.fine ? 1 : most), race.hand[1]];
  }
}
