/*
 * The keys that steer. The others are those of the page's help, whose `kbd` elements say what they do.
 */

const STRIDE = { circle: 10, size: 5 }; // [px] that a key moves or sizes a drawn circle
const ARROWS = {
  arrowleft: "left", arrowright: "right", arrowup: "up", arrowdown: "down",
  a: "left", d: "right", w: "up", s: "down",
};
const WAYS = { left: [-1, 0], right: [1, 0], up: [0, 1], down: [0, -1] };

class Keyboard {
  /** app: the page. */
  constructor(app) {
    this.app = app;
    this.held = new Set(); // arrow keys that are down
    this.tapped = new Set(); // those that went down since the last step
    this.fine = false; // whether Shift was down
    document.addEventListener("keydown", (event) => this.press(event));
    document.addEventListener("keyup", (event) => this.held.delete(ARROWS[nameOfKey(event)]));
    addEventListener("blur", () => this.held.clear());
  }

  press(event) {
    const arrow = ARROWS[freeKey(event)];
    if (!arrow) return;
    event.preventDefault();
    if (this.app.stage.drawing) {
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

  /** The turn [degrees] and distance [px] of the next step: a key tapped since the last one counts once. */
  hand() {
    const { race, world } = this.app;
    const keys = new Set([...this.held, ...this.tapped]);
    const way = Number(keys.has("left")) - Number(keys.has("right"));
    this.tapped.clear();
    return [clamp(way * (this.fine ? 1 : 180), ...furthestTurns(world)), race.hand[1]];
  }
}
