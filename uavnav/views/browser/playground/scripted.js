/*
 * The scripted policies of uavnav/tasks/baselines.py and classics.py: functions of what is sensed.
 */

const MARGIN = 0.01; // [px] against rounding

/** Slots, each as { right, forward, distance [px] }. */
function echoesIn(world, slots) {
  const span = world.sensor_radius - world.drone_radius;
  const echo = ([right, forward, proximity]) => ({ right, forward, distance: f32(world.drone_radius + f32(proximity * span)) });
  return slots.map(echo);
}

/** Those that have a direction. */
function bodiesIn(world, observation) {
  return echoesIn(world, slotsOf(world, observation).filter(isFilled));
}

/** How much of [right, forward] lies in the direction of a turn [degrees, left positive]. */
function along({ right, forward }, degrees) {
  return forward * Math.cos(radians(degrees)) - right * Math.sin(radians(degrees));
}

/** Fly straight at full speed where that is certainly safe, else turn left on the spot. */
function reactive(world, observation) {
  const full = world.n_distances - 1;
  const safe = echoesIn(world, slotsOf(world, observation)).every(
    ({ forward, distance }) => f32(distance - f32(full * forward)) > f32(world.drone_radius + MARGIN),
  );
  return encode(world, safe ? [0, full] : [furthestTurns(world)[1], 0]);
}

/** Turn to the free direction that is nearest to the goal's, and fly as far as is certainly safe. */
function towardsGoal(world, observation, { scale, bearings, look, spare }) {
  const [right, forward, away] = observation.subarray(3 * world.n_slots);
  const echoes = bodiesIn(world, observation);
  const reach = Math.min(away * scale, look);
  const isFree = (bearing) =>
    echoes.every((echo) => {
      const closing = along(echo, -bearing);
      const flown = clamp(echo.distance * closing, 0, reach); // where it is nearest
      const nearest = Math.sqrt(echo.distance ** 2 - 2 * flown * echo.distance * closing + flown ** 2);
      return nearest > world.drone_radius + spare || closing <= 0;
    });
  const goal = Math.atan2(right, forward) / radians(1);
  const free = bearings.filter(isFree).map((bearing) => [Math.abs(bearing - goal), bearing]);
  const wanted = free.length ? free.reduce((one, other) => (other[0] < one[0] ? other : one))[1] : -90;
  const angle = clamp(-wanted, ...furthestTurns(world));
  const rooms = echoes.map((echo) => {
    const closing = along(echo, angle);
    return closing > 0 ? (echo.distance - world.drone_radius - MARGIN) / closing : Infinity;
  });
  const safe = Math.floor(clamp(Math.min(...rooms), 0, world.n_distances - 1));
  return encode(world, [angle, Math.abs(wanted) >= 45 ? 0 : safe]);
}

/** The first action of the way that keeps most clear of what is in view, also if that comes nearer by itself. */
function dodge(world, observation, { ways, body, drift, enough }) {
  const echoes = bodiesIn(world, observation);
  const centres = echoes.map(({ right, forward, distance }) => [right * (distance + body), forward * (distance + body)]);
  let [chosen, most] = [0, -Infinity];
  for (const [places, first, worth] of ways) {
    let clear = enough;
    places.forEach(([x, y], nth) => {
      for (const [cx, cy] of centres) {
        const apart = Math.sqrt((x - cx) ** 2 + (y - cy) ** 2);
        clear = Math.min(clear, apart - body - world.drone_radius - drift * (nth + 1));
      }
    });
    if (clear + worth > most) [chosen, most] = [first, clear + worth];
  }
  return chosen;
}

/** Where to fly: [right, forward, px]; straight ahead where no goal is sensed. */
function targetOf(world, observation, { scale }) {
  const [right, forward, away] = observation.subarray(3 * world.n_slots);
  return scale === undefined ? [0, 1, Infinity] : [right, forward, away * scale];
}

/** The action whose displacement is nearest to a wanted one [px]; see uavnav/tasks/sensed.py. */
function steer(world, [right, forward], tolerance) {
  const isAhead = forward >= Math.hypot(right, forward) * Math.cos(radians(tolerance));
  let [chosen, most] = [0, -Infinity];
  for (let action = 0; action < world.n_turns * world.n_distances; action += 1) {
    const [degrees, pixels] = decode(world, action);
    const reached = along({ right, forward }, degrees);
    const score = pixels * (2 * reached - pixels) + 0.01 * reached;
    if (score > most && !(isAhead && degrees !== 0)) [chosen, most] = [action, score];
  }
  return chosen;
}

/** Artificial potential field: the target pulls, each body within reach pushes. */
function apf(world, observation, rules) {
  const { gain, reach, tolerance } = rules.classics.apf;
  let [right, forward, away] = targetOf(world, observation, rules);
  for (const echo of bodiesIn(world, observation)) {
    const rho = Math.max(echo.distance - world.drone_radius, 1);
    const push = rho > reach ? 0 : (gain * (1 / rho - 1 / reach)) / rho ** 2;
    right -= push * echo.right;
    forward -= push * echo.forward;
  }
  const pace = Math.min(away, world.n_distances - 1) / Math.max(Math.hypot(right, forward), 1e-6);
  return steer(world, [pace * right, pace * forward], tolerance);
}

/** Vector field histogram, VFH+: towards the cheapest opening between sectors that bodies block. */
function vfh(world, observation, rules) {
  const { window, spare, wide, sectors, aside } = rules.classics.vfh;
  const [right, forward, away] = targetOf(world, observation, rules);
  const reach = Math.min(away, window) + world.drone_radius;
  const near = bodiesIn(world, observation).filter((echo) => echo.distance < reach);
  const isBlocked = (sector) =>
    near.some((echo) => {
      const half = Math.asin(Math.min((world.drone_radius + spare) / echo.distance, 1));
      return Math.abs(radians(sector) - Math.atan2(echo.right, echo.forward)) <= half;
    });
  const blocked = sectors.map(isBlocked);
  const aim = Math.atan2(right, forward) / radians(1);
  let [wanted, least] = [-90, Infinity];
  sectors.forEach((sector, at) => {
    const [before, after] = [blocked.lastIndexOf(true, at), blocked.indexOf(true, at)];
    const [left, open] = [before < 0 ? Infinity : at - before, after < 0 ? Infinity : after - at];
    const cost = 5 * Math.abs(((sector - aim + 540) % 360) - 180) + 2 * Math.abs(sector);
    const isOpen = Math.min(left, open) >= wide || Math.abs(left - open) <= 1;
    if (!blocked[at] && isOpen && cost < least) [wanted, least] = [sector, cost];
  });
  const angle = clamp(-wanted, ...furthestTurns(world));
  const densities = near.map(
    (echo) => Math.max(along(echo, angle), 0) * (1 - (echo.distance - world.drone_radius) / window),
  );
  const pace = (world.n_distances - 1) * (1 - Math.max(0, ...densities)) * Math.max(0, 1 - Math.abs(wanted) / aside);
  return encode(world, [angle, Math.round(pace)]);
}

/** What `reactive` does in each world: of its constants, an observation, and the `rules` of that world. */
const REACTIONS = { drone: reactive, slalom: reactive, moving: dodge, goal: towardsGoal };
const REACTIVE = "reactive";

/** Every scripted policy: of a world's name, its task, an observation and uniform random numbers, an action. */
const SCRIPTED = {
  [REACTIVE]: (name, { world, rules }, observation) => REACTIONS[name](world, observation, rules),
  apf: (name, { world, rules }, observation) => apf(world, observation, rules),
  vfh: (name, { world, rules }, observation) => vfh(world, observation, rules),
  straight: (name, { world }) => encode(world, [0, world.n_distances - 1]),
  random: (name, { world }, observation, draw) => Math.floor(world.n_turns * world.n_distances * draw()),
};
