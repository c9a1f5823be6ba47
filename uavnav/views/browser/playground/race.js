/*
 * The race: up to four drones on the same obstacles, each flown by a person, a policy or the rule. It holds the state and
 * draws nothing; what happens is asked of a task of world.js.
 */

const TRAIL = 1500; // points of a trail that are kept, up to the pose before the last
const ROUNDED = 0.15; // [px] that a link, which has one decimal, may bring a circle nearer

class Race {
  /** tasks: constants of each world; policies: of the page, each with its key; scene: as link.js has it. */
  constructor(tasks, policies, scene) {
    Object.assign(this, { tasks, policies });
    this.thinkers = Object.fromEntries(policies.map((policy) => [policy.key, thinker(policy)]));
    this.hand = [0, 0]; // what a person steers: a turn [degrees] and a distance [px]
    this.load(scene);
  }

  /** Begin a scene from its start. */
  load(scene) {
    this.scene = { ...scene };
    const { noise, lost, late, sticky } = scene;
    const given = this.tasks[scene.world];
    const world = scene.world === "moving" ? { ...given.world, speed_max: scene.pace } : given.world;
    this.task = new TASKS[scene.world]({ ...given, world }, { noise, lost, late, sticky });
    this.set = this.task.generate(scene);
    if (scene.circles) this.set = this.task.arrange(this.set, scene.circles, scene.set);
    this.again();
  }

  get world() {
    return this.task.world;
  }

  /** Those of the set, as they are at the start: [x, y, radius] px. */
  get circles() {
    return this.set.circles.map((circle) => circle.slice(0, 3));
  }

  /** What circles leave free: [x, y, room] px. */
  get free() {
    return this.task.free(this.set);
  }

  /** Whether all circles leave free what they must, as far as a link can say. */
  circlesFit() {
    return this.circles.every((circle) => this.free.every(([x, y, room]) => isClear([x, y, room - ROUNDED], circle)));
  }

  /** Every drone back at the start, on the same obstacles and with the same random numbers. */
  again() {
    this.steps = 0;
    this.drones = this.scene.pilots.map((pilot, place) => {
      const seed = this.scene.seed + place * 0x9e3779b1;
      const [draw, chance] = [randomNumbers(seed), randomNumbers(seed ^ 0x3c6ef372)]; // of the policy, and of faults
      const state = this.task.start(this.set, this.task.draw(chance));
      const before = this.drones?.[place].before ?? pilot; // who had it, if someone else has it now
      const other = before === pilot ? (pilot === YOU ? RULE : YOU) : before;
      return { pilot, before: other, state, last: state, trail: [], draw, chance, ended: "" };
    });
    this.drones.forEach((drone) => this.look(drone));
  }

  /** Other obstacles, while everyone flies on. */
  replaceCircles(circles) {
    this.set = this.task.arrange(this.set, circles, this.scene.set);
    for (const drone of this.drones) {
      if (!drone.ended) this.wake(drone);
    }
  }

  /** Hand a drone to someone else, where it is. A person flies one drone alone: another one goes back to who had it. */
  handTo(place, pilot) {
    const other = this.drones.findIndex((drone) => drone.pilot === YOU);
    if (pilot === YOU && other >= 0 && other !== place) this.handTo(other, this.drones[other].before);
    const drone = this.drones[place];
    if (drone.pilot === pilot) return;
    const waited = this.steps > 0 && !this.canFly(drone.pilot);
    if (drone.pilot !== NOBODY) drone.before = drone.pilot;
    drone.pilot = pilot;
    this.scene.pilots[place] = pilot;
    if (drone.ended) return;
    if (waited) this.wake(drone);
    else this.decide(drone);
  }

  greedy(greedy) {
    this.scene.greedy = greedy;
    this.drones.forEach((drone) => drone.ended || this.decide(drone));
  }

  /** Sense what is there now, whatever was sensed before. */
  wake(drone) {
    drone.state = this.task.remember(drone.state, this.set, this.task.draw(drone.chance));
    this.look(drone);
  }

  look(drone) {
    Object.assign(drone, this.task.observe(drone.state, this.set));
    this.decide(drone);
  }

  /** Whether a pilot knows what there is to see in this world: a network reads so many numbers and no others. */
  canFly(pilot) {
    const policy = this.policies.find(({ key }) => key === pilot);
    return pilot !== NOBODY && (!policy || policy.sizes[0] === this.task.observationSize);
  }

  /** What the drone will do from here, and why: `thought` holds an action, and of a policy the numbers behind it. */
  decide(drone) {
    if (drone.pilot === YOU || !this.canFly(drone.pilot)) drone.thought = {};
    else if (drone.pilot === RULE) {
      drone.thought = { action: RULES[this.scene.world](this.world, drone.observation, this.task.rules) };
    } else drone.thought = this.thinkers[drone.pilot](drone.observation, drone.draw, this.scene.greedy);
  }

  /** Those that are in the race and have not ended. */
  flying() {
    return this.drones.filter((drone) => this.canFly(drone.pilot) && !drone.ended);
  }

  /** One step of everyone; who is not flown waits where it is. -> the drones that ended in it */
  step() {
    const flying = this.flying();
    this.steps += 1;
    for (const drone of this.drones) {
      if (!drone.ended && !flying.includes(drone)) drone.state = drone.last = { ...drone.state, waited: drone.state.waited + 1 };
    }
    for (const drone of flying) {
      const action = drone.thought.action ?? encode(this.world, this.hand);
      drone.last = drone.state;
      drone.trail.push([drone.last.x, drone.last.y]);
      Object.assign(drone, this.task.step(drone.state, action, this.set, this.task.draw(drone.chance)));
      if (drone.trail.length > TRAIL) drone.trail.shift();
      if (!drone.ended) this.decide(drone);
    }
    return flying.filter((drone) => drone.ended);
  }

  /** Where the obstacles are so much of the way [0 to 1] from the last step to this one, for a picture. */
  obstaclesAt(share) {
    return this.task.obstacles(this.set, Math.max(0, this.steps - 1 + share));
  }

  /** Where a drone is so much of the way [0 to 1] from its last pose to this one, for a picture. */
  poseAt(drone, share) {
    const [from, to] = [drone.last, drone.state];
    const turn = ((to.heading - from.heading + 540) % 360) - 180;
    const between = (name) => from[name] + share * (to[name] - from[name]);
    return { x: between("x"), y: between("y"), angle: radians(from.heading + share * turn) };
  }
}
