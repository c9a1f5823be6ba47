/*
 * Recorded episodes side by side on the same obstacles: new Together(root, data) lets them play by
 * themselves, layout after layout. Where the reader asks for less motion, they wait for the button.
 *
 * `root` contains a figure with a canvas and an output for each drone, and a button. `data` is what
 * `together` of uavnav/views/replays.py gives; drawing.js draws it.
 */

const TOGETHER_SPEED = 60; // [steps / s]
const TRAIL = 160; // [steps] that a trail is long
const STILL = 240; // [steps] where episodes stand that do not play
const REST = 1.5; // [s] after the last episode of a layout

class Together extends Playing {
  constructor(root, data) {
    super();
    this.data = data;
    root.hidden = false;
    this.drones = [...root.querySelectorAll("figure")].map((figure, place) => ({
      canvas: figure.querySelector("canvas"),
      output: figure.querySelector("output"),
      episodes: data.drones[place].episodes,
    }));
    this.listenTo(root);
    this.playing = !matchMedia("(prefers-reduced-motion: reduce)").matches;
    watchLooks(root, () => this.draw());
    const palette = new MutationObserver(() => this.draw()); // the button of a site
    palette.observe(document.body, { attributeFilter: ["data-md-color-scheme"] });
    this.load(0);
  }

  /** Unpack the episodes on a layout, and begin. */
  async load(layout) {
    const episodes = this.drones.map((drone) => drone.episodes[layout]);
    const every = await Promise.all(episodes.map((episode) => unpack(episode, this.data.fields)));
    every.forEach((read, place) => Object.assign(this.drones[place], { episode: episodes[place], read }));
    this.layout = layout;
    this.last = Math.max(...episodes.map(({ steps }) => steps));
    this.step = this.playing ? 0 : Math.min(STILL, this.last);
    this.draw();
    if (this.playing) this.start();
  }

  start() {
    this.due = this.step; // whole and parts, also beyond the last
    this.play();
  }

  pause() { this.playing = false; }

  frame(seconds) {
    this.due += seconds * TOGETHER_SPEED;
    if (this.due > this.last + REST * TOGETHER_SPEED) {
      this.turn = null; // the next layout begins a loop of its own
      this.load((this.layout + 1) % this.data.layouts.length);
    } else if (this.step < this.last) {
      this.step = Math.min(Math.floor(this.due), this.last);
      this.draw();
    }
  }

  draw() {
    if (this.step === undefined) return;
    for (const { canvas, output, episode, read } of this.drones) {
      const step = Math.min(this.step, episode.steps);
      const drone = { ...droneAt(this.data.world, episode, read, step, TRAIL), fades: true };
      if (drone.crashed) drone.sensed = [];
      drawArena(canvas, { world: this.data.world, circles: this.data.layouts[this.layout], drones: [drone] });
      const reward = `reward ${fixed(read.reward(step), 1)}`;
      const at = step.toLocaleString("en");
      const ended = step < episode.steps ? "" : drone.crashed ? "collided at " : "stopped at ";
      output.textContent = `${reward}, ${ended}step ${at}`;
    }
  }
}
