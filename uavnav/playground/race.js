/*
 * The race: up to four drones on the same obstacles, each flown by a person, a policy or the rule. It holds the state and
 * draws nothing. `task` holds a world's functions (PAPER of world.js).
 */

const TRAIL = 1500; // points of a trail that are kept, up to the pose before the last

class Race {
  /** world: constants; policies: of the page, each with its key; scene: as link.js has it. */
  constructor(task, world, policies, scene) {
    Object.assign(this, { task, world });
    this.thinkers = Object.fromEntries(policies.map((policy) => [policy.key, thinker(policy)]));
    this.hand = [0, 0]; // what a person steers: a turn [degrees] and a distance [px]
    this.load(scene);
  }

  /** Begin a scene from its start. */
  load(scene) {
    this.scene = { ...scene };
    this.circles = scene.circles ?? this.task.generate(this.world, scene.k, scene.set);
    this.again();
  }

  /** Every drone back at the start, on the same obstacles and with the same random numbers. */
  again() {
    this.drones = this.scene.pilots.map((pilot, place) => {
      const state = this.task.start(this.world);
      const draw = randomNumbers(this.scene.seed + place * 0x9e3779b1);
      const before = this.drones?.[place].before ?? pilot; // who had it, if someone else has it now
      const other = before === pilot ? (pilot === YOU ? RULE : YOU) : before;
      return { pilot, before: other, state, last: state, trail: [], draw };
    });
    this.drones.forEach((drone) => this.look(drone));
  }

  /** Other obstacles, while everyone flies on. */
  replaceCircles(circles) {
    this.circles = circles;
    for (const drone of this.drones) if (!drone.crashed) this.look(drone);
  }

  /** Hand a drone to someone else, where it is. A person flies one drone alone: another one goes back to who had it. */
  handTo(place, pilot) {
    const other = this.drones.findIndex((drone) => drone.pilot === YOU);
    if (pilot === YOU && other >= 0 && other !== place) this.handTo(other, this.drones[other].before);
    const drone = this.drones[place];
    if (drone.pilot === pilot) return;
    if (drone.pilot !== NOBODY) drone.before = drone.pilot;
    drone.pilot = pilot;
    this.scene.pilots[place] = pilot;
    if (!drone.crashed) this.decide(drone);
  }

  greedy(greedy) {
    this.scene.greedy = greedy;
    this.drones.forEach((drone) => drone.crashed || this.decide(drone));
  }

  look(drone) {
    Object.assign(drone, this.task.sense(this.world, drone.state, this.circles));
    this.decide(drone);
  }

  /** What the drone will do from here, and why: `thought` holds an action, and of a policy the numbers behind it. */
  decide(drone) {
    if (drone.pilot === YOU || drone.pilot === NOBODY) drone.thought = {};
    else if (drone.pilot === RULE) drone.thought = { action: reactive(this.world, drone.observation) };
    else drone.thought = this.thinkers[drone.pilot](drone.observation, drone.draw, this.scene.greedy);
  }

  /** Those that are in the race and have not crashed. */
  flying() {
    return this.drones.filter((drone) => drone.pilot !== NOBODY && !drone.crashed);
  }

  /** One step of everyone. -> the drones that crashed in it */
  step() {
    const flying = this.flying();
    for (const drone of flying) {
      const action = drone.thought.action ?? encode(this.world, this.hand);
      const { state, ...seen } = this.task.step(this.world, drone.state, action, this.circles);
      drone.last = drone.state;
      drone.trail.push([drone.last.x, drone.last.y]);
      Object.assign(drone, { state, observation: seen.observation, clearance: seen.clearance, crashed: seen.collided });
      if (drone.trail.length > TRAIL) drone.trail.shift();
      if (!drone.crashed) this.decide(drone);
    }
    return flying.filter((drone) => drone.crashed);
  }

  /** Where a drone is so much of the way [0 to 1] from its last pose to this one, for a picture. */
  poseAt(drone, share) {
    const [from, to] = [drone.last, drone.state];
    const turn = ((to.heading - from.heading + 540) % 360) - 180;
    const between = (name) => from[name] + share * (to[name] - from[name]);
    return { x: between("x"), y: between("y"), angle: ((from.heading + share * turn) * Math.PI) / 180 };
  }
}
