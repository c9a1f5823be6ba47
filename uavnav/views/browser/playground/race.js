/*
 * The race: up to four drones on the same obstacles, each flown by a person, a policy or a scripted policy.
 * It has the state and draws nothing; what happens is asked of a task of world.js.
 */

const TRAIL = 1500; // points of a trail that are kept, up to the pose before the last
const ROUNDED = 0.15; // [px] that a link, which has one decimal, may bring a circle nearer

class Race {
  /** data: the page's, with constants of each task, layouts and policies; scene: as link.js has it. */
  constructor({ tasks, layouts, policies }, scene) {
    Object.assign(this, { tasks, layouts, policies });
    this.load(scene);
  }

  /** Begin a scene from its start. */
  load(scene) {
    const given = this.tasks[scene.task];
    const split = this.layouts[scene.task]?.[scene.layouts];
    this.scene = split ? { ...scene, layout: scene.layout % split.length } : { ...scene, layouts: RANDOM };
    const moves = scene.task === "moving";
    if (moves && split && !scene.circles) this.scene.pace = given.world.speed_max; // the split's own
    const { noise, lost, late, sticky, pace } = this.scene;
    const speeds = moves && { speed_min: Math.min(given.world.speed_min, pace), speed_max: pace };
    const world = { ...given.world, ...speeds };
    this.task = new TASKS[scene.task]({ ...given, world }, { noise, lost, late, sticky });
    this.layout = split ? unpacked(split[this.scene.layout]) : this.task.generate(scene);
    if (scene.circles) this.layout = this.task.arrange(this.layout, scene.circles, scene.layout);
    this.again();
  }

  /** Those of the layout, as they are at the start: [x, y, radius] px. */
  get circles() { return this.layout.circles.map((circle) => circle.slice(0, 3)); }

  /** What circles leave free: [x, y, room] px. */
  get free() { return this.task.free(this.layout); }

  /** Whether all circles leave free what they must, as far as a link can say. */
  circlesFit() {
    const fits = (circle) => this.free.every((place) => toEdge(place, circle) >= place[2] - ROUNDED);
    return this.circles.every(fits);
  }

  /** Every drone back at the start, on the same obstacles and with the same random numbers. */
  again() {
    this.steps = 0;
    this.hand = [0, 0]; // what a person steers: a turn [degrees] and a distance [px]
    this.begun = false; // whether the person steers; before, that drone waits at the start
    this.drones = this.scene.pilots.map((pilot, place) => {
      const seed = this.scene.seed + place * 0x9e3779b1;
      const [draw, chance] = [seed, seed ^ 0x3c6ef372].map(randomNumbers); // of the policy, and of faults
      const state = this.task.start(this.layout, this.task.draw(chance));
      const before = this.drones?.[place].before ?? REACTIVE; // to whom a person hands it back
      return { place, pilot, before, state, last: state, trail: [], draw, chance, ended: "", handed: false };
    });
    this.drones.forEach((drone) => this.look(drone));
  }

  /** Other obstacles, while everyone flies on. */
  replaceCircles(circles) {
    this.layout = this.task.arrange(this.layout, circles, this.scene.layout);
    for (const drone of this.drones) {
      if (!drone.ended) this.wake(drone);
    }
  }

  /**
   * Hand a drone to someone else, where it is. One that has ended stays with the pilot who ended it: the
   * other one has it from the next start. A person flies one drone only: another one goes back to who had it.
   */
  handTo(place, pilot) {
    const { pilots } = this.scene;
    const [drone, had, other] = [this.drones[place], pilots[place], pilots.indexOf(YOU)];
    if (had === pilot) return;
    if (pilot === YOU && other >= 0) this.handTo(other, this.drones[other].before);
    if (had !== NOBODY && had !== YOU) drone.before = had;
    this.scene.pilots = this.scene.pilots.with(place, pilot);
    if (drone.ended) return;
    drone.pilot = pilot;
    drone.handed = drone.handed || this.steps > 0;
    if (pilot === YOU) this.begun = this.steps > 0;
    this.decide(drone);
  }

  /** The person begins to steer: the drone that waited takes off. */
  begin() {
    if (this.yours && !this.yours.ended) this.begun = true;
  }

  greedy(greedy) {
    this.scene.greedy = greedy;
    this.drones.forEach((drone) => drone.ended || this.decide(drone));
  }

  /** Sense what is there now, whatever was sensed before. */
  wake(drone) {
    drone.state = this.task.remember(drone.state, this.layout, this.task.draw(drone.chance));
    this.look(drone);
  }

  look(drone) {
    Object.assign(drone, this.task.observe(drone.state, this.layout));
    this.decide(drone);
  }

  policyOf(pilot) { return this.policies.find(({ key }) => key === pilot); }

  /** Whether a pilot knows what there is to see in this world: a network reads so many numbers, no others. */
  canFly(pilot) {
    const policy = this.policyOf(pilot);
    return pilot !== NOBODY && (!policy || policy.sizes[0][0] === this.task.observationSize);
  }

  /** What the drone will do from here: `thought` has an action, and of a policy the numbers behind it. */
  decide(drone) {
    const { task, scene } = this;
    const { pilot, observation, draw } = drone;
    const script = SCRIPTED[pilot];
    if (pilot === YOU || !this.canFly(pilot)) drone.thought = {};
    else if (script) drone.thought = { action: script(scene.task, task, observation, draw) };
    else drone.thought = think(this.policyOf(pilot), observation, draw, scene.greedy);
  }

  /** The person's drone, rather one that flies than one that has ended; undefined where there is none. */
  get yours() {
    const yours = this.drones.filter(({ pilot }) => pilot === YOU);
    return yours.find(({ ended }) => !ended) ?? yours[0];
  }

  /** Those that are in the race: whose pilots can fly here. */
  get piloted() { return this.drones.filter(({ pilot }) => this.canFly(pilot)); }

  /** Those that are in the race and have not ended. */
  flying() {
    return this.piloted.filter(({ pilot, ended }) => !ended && (pilot !== YOU || this.begun));
  }

  /** One step of everyone; who is not flown waits where it is. -> the drones that ended in it */
  step() {
    const flying = this.flying();
    this.steps += 1;
    for (const drone of this.drones) {
      if (drone.ended || flying.includes(drone)) continue;
      drone.state = drone.last = { ...drone.state, waited: drone.state.waited + 1 };
      this.wake(drone);
    }
    for (const drone of flying) {
      const action = drone.thought.action ?? encode(this.task.world, this.hand);
      drone.last = drone.state;
      drone.trail.push([drone.last.x, drone.last.y]);
      Object.assign(drone, this.task.step(drone.state, action, this.layout, this.task.draw(drone.chance)));
      if (drone.trail.length > TRAIL) drone.trail.shift();
      if (!drone.ended) this.decide(drone);
    }
    return flying.filter((drone) => drone.ended);
  }

  /** Where the obstacles are so much of the way [0 to 1] from the last step to this one, for a picture. */
  obstaclesAt(share) {
    return this.task.obstacles(this.layout, Math.max(0, this.steps - 1 + share));
  }

  /** Where a drone is so much of the way [0 to 1] from its last pose to this one, for a picture. */
  poseAt(drone, share) {
    const [from, to] = [drone.last, drone.state];
    const turn = ((to.heading - from.heading + 540) % 360) - 180;
    const between = (name) => from[name] + share * (to[name] - from[name]);
    return { x: between("x"), y: between("y"), angle: radians(from.heading + share * turn) };
  }
}

/** A layout of the page, whose circles are rows of so many columns in base64. */
function unpacked({ circles, columns, goal }) {
  const numbers = floats(circles);
  const row = (nth) => [...numbers.subarray(columns * nth, columns * (nth + 1))];
  return { circles: Array.from({ length: numbers.length / columns }, (_, nth) => row(nth)), goal };
}
