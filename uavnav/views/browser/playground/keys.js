/*
 * The keyboard: the arrow keys that steer, and the keys of the page's help, whose `kbd` elements name them in `data-keys` and
 * say what they do as buttons do; `data-repeats` where they act again while they are held down.
 */

const STRIDE = { circle: 10, size: 5 }; // [px] that a key moves or sizes a drawn circle
const ARROWS = { arrowleft: "left", arrowright: "right", arrowup: "up", arrowdown: "down", a: "left", d: "right", w: "up", s: "down" };
const WAYS = { left: [-1, 0], right: [1, 0], up: [0, 1], down: [0, -1] };

/** The name of a key, whether Shift is down or not. */
function nameOfKey({ key }) {
  return key === " " ? "space" : key.toLowerCase();
}

class Keyboard {
  /** app: the page. */
  constructor(app) {
    this.app = app;
    const help = [...document.querySelectorAll("[data-keys]")];
    this.help = Object.fromEntries(help.flatMap((one) => one.dataset.keys.split(" ").map((key) => [key, one])));
    this.held = new Set(); // arrow keys that are down
    this.tapped = new Set(); // those that went down since the last step
    this.fine = false; // whether Shift was down
    document.addEventListener("keydown", (event) => this.press(event));
    document.addEventListener("keyup", (event) => this.held.delete(ARROWS[nameOfKey(event)]));
    addEventListener("blur", () => this.held.clear());
  }

  /** Keys work where nothing else uses them: a button has Space and Enter, a field or a list has all. */
  press(event) {
    const { stage } = this.app;
    const key = nameOfKey(event);
    const taken = event.target.closest("select, input") || (event.target.closest("button, summary") && ["space", "enter"].includes(key));
    if (taken || event.altKey || event.ctrlKey || event.metaKey) return;
    const [arrow, act] = [ARROWS[key], this.help[key]];
    if (!arrow && !act) return;
    event.preventDefault();
    if (act) {
      if (!event.repeat || "repeats" in act.dataset) this.app.act(act);
    } else if (stage.drawing) {
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
    this.tapped.clear();
    return [clamp(way * (this.fine ? 1 : 180), ...furthestTurns(world)), race.hand[1]];
  }
}
