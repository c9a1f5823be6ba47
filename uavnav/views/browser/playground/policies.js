/*
 * Trained networks, as uavnav/networks.py and uavnav/acting.py have them: functions of what is sensed and of
 * uniform random numbers.
 *
 * A network's numbers are float32; sums are double, so that outputs differ from PyTorch's in their last bits.
 */

/** The polynomial with these coefficients, the constant first, by Horner's rule. */
function polynomial(coefficients, x) {
  return coefficients.reduceRight((sum, coefficient) => sum * x + coefficient, 0);
}

/** The error function (Abramowitz and Stegun 7.1.26, within 1.5e-7). */
function erf(x) {
  const t = 1 / (1 + 0.3275911 * Math.abs(x));
  const terms = [0.254829592, -0.284496736, 1.421413741, -1.453152027, 1.061405429];
  return Math.sign(x) * (1 - t * polynomial(terms, t) * Math.exp(-x * x));
}

const sigmoid = (x) => 1 / (1 + Math.exp(-x));
const softplus = (x) => (x > 20 ? x : Math.log1p(Math.exp(x)));

const ACTIVATIONS = {
  relu: (x) => Math.max(x, 0),
  leaky_relu: (x) => (x > 0 ? x : 0.01 * x),
  sigmoid,
  tanh: Math.tanh,
  elu: (x) => (x > 0 ? x : Math.expm1(x)),
  gelu: (x) => 0.5 * x * (1 + erf(x / Math.SQRT2)),
  silu: (x) => x * sigmoid(x),
  mish: (x) => x * Math.tanh(softplus(x)),
  selu: (x) => 1.0507009873554805 * (x > 0 ? x : 1.6732632423543772 * Math.expm1(x)),
  softplus,
  softsign: (x) => x / (1 + Math.abs(x)),
  identity: (x) => x,
  hardtanh: (x) => clamp(x, -1, 1),
  relu6: (x) => clamp(x, 0, 6),
  sigmoid_centred: (x) => 2 * sigmoid(x) - 1,
};

/** A rational function with six coefficients above and four below: uavnav/networks.py. */
function rational(x, learned) {
  const below = [1, ...learned.slice(6).map(Math.abs)];
  return polynomial(learned.slice(0, 6), x) / polynomial(below, Math.abs(x));
}

/** Activations that are no function of one number: of a layer's sums, and of numbers that they learned. */
const LAYERS = {
  crelu: (sums) => [...sums, ...sums.map((x) => -x)].map(ACTIVATIONS.relu),
  fourier: (sums) => [...[...sums].map(Math.sin), ...[...sums].map(Math.cos)],
  hadamard: (sums) => {
    const [first, second] = [sums.slice(0, sums.length / 2), sums.slice(sums.length / 2)];
    return first.map((x, unit) => Math.tanh(x) * Math.tanh(second[unit]));
  },
  rational: (sums, learned) => sums.map((x) => rational(x, learned)),
};

/** What a layer's sums become by an activation. */
function activated(name, sums, learned) {
  return name in LAYERS ? Float32Array.from(LAYERS[name](sums, learned)) : sums.map(ACTIVATIONS[name]);
}

/** Base64 of little-endian float32 as numbers. */
function floats(text) { return new Float32Array(bytesOf(text).buffer); }

/** Values that LayerNorm centres and scales. */
function normalised(values) {
  const mean = values.reduce((sum, value) => sum + value, 0) / values.length;
  const variance = values.reduce((sum, value) => sum + (value - mean) ** 2, 0) / values.length;
  return values.map((value) => (value - mean) / Math.sqrt(variance + 1e-5));
}

/** One layer: bias [out] + inputs [in] x weight [in, out]. */
function linear(inputs, weight, bias) {
  const sums = Float64Array.from(bias);
  inputs.forEach((input, from) => {
    for (let to = 0; to < sums.length; to += 1) sums[to] += input * weight[from * sums.length + to];
  });
  return Float32Array.from(sums);
}

/** A state's values and each action's advantages, `atoms` numbers each, as the actions': v + a - mean a. */
function dueling(outputs, atoms = 1) {
  const actions = outputs.length / atoms - 1;
  const advantages = outputs.subarray(atoms);
  const means = new Float64Array(atoms);
  advantages.forEach((advantage, place) => { means[place % atoms] += advantage / actions; });
  return advantages.map((advantage, place) => outputs[place % atoms] + advantage - means[place % atoms]);
}

/** Expected returns, from the logits of `atoms` evenly spaced returns for each action. */
function expected(logits, least, most, atoms) {
  const spacing = (most - least) / (atoms - 1);
  return Float32Array.from({ length: logits.length / atoms }, (_, action) => {
    const shares = softmax(logits.subarray(action * atoms, (action + 1) * atoms));
    return shares.reduce((sum, share, atom) => sum + share * (least + atom * spacing), 0);
  });
}

/** How a network's outputs are read as one number an action: what a policy's file names, with its numbers. */
const HEADS = {
  direct: (outputs) => outputs,
  dueling: (outputs) => dueling(outputs),
  distribution: expected,
  "dueling-distribution": (outputs, ...numbers) => expected(dueling(outputs, numbers.at(-1)), ...numbers),
};

/** A trained network: observation -> { hidden: each hidden layer's activations, values: one an action }. */
function network({ sizes, activation, layer_norm, head, weights }) {
  const numbers = floats(weights);
  let at = 0;
  const take = (count) => numbers.subarray(at, (at += count));
  const layers = sizes.map(([inputs, outputs, own]) => [inputs * outputs, outputs, own].map(take));
  const last = layers.pop();
  const [name, ...given] = head.split(" ");
  const valuesOf = (outputs) => HEADS[name](outputs, ...given.map(Number));
  return (observation) => {
    const hidden = [];
    let inputs = observation;
    for (const [weight, bias, learned] of layers) {
      const sums = linear(inputs, weight, bias);
      inputs = activated(activation, layer_norm ? normalised(sums) : sums, learned);
      hidden.push(inputs);
    }
    return { hidden, values: valuesOf(linear(inputs, ...last)) };
  };
}

function softmax(values) {
  const largest = Math.max(...values);
  const powers = Array.from(values, (value) => Math.exp(value - largest));
  const sum = powers.reduce((one, other) => one + other);
  return powers.map((power) => power / sum);
}

/** The place of the first largest value; -1 of none. */
function best(values) { return values.indexOf(Math.max(...values)); }

/** Ways to act in training: each chooses an action of the values, with uniform random numbers. */
const ACTS = {
  /** An action from softmax(values) by inverting its cumulative distribution. */
  categorical: (values, epsilon, draw) => {
    const uniform = draw();
    let [cumulative, action] = [0, 0];
    for (const share of softmax(values)) {
      cumulative += share;
      if (cumulative > uniform) break;
      action += 1;
    }
    return Math.min(action, values.length - 1);
  },
  /** The best action, or with probability epsilon a uniformly random one. */
  "epsilon-greedy": (values, epsilon, draw) => {
    const [coin, choice] = [draw(), draw()];
    const explored = Math.min(Math.floor(choice * values.length), values.length - 1);
    return coin < epsilon ? explored : best(values);
  },
};

/** What a picture shows of a policy's values. */
const SHOWN = { probability: softmax, "Q value": (values) => [...values] };

/**
 * What a policy of the page makes of an observation: { action, hidden, shown, low, high }, where `shown`
 * [actions] is what a picture shows, from `low` to `high`. draw: uniform random numbers; greedy: the best
 * action always.
 */
function think(policy, observation, draw, greedy) {
  policy.network ??= network(policy); // unpacked when it is first asked
  const { hidden, values } = policy.network(observation);
  const action = greedy ? best(values) : ACTS[policy.acts](values, policy.epsilon, draw);
  const shown = SHOWN[policy.shown](values);
  return { action, hidden, shown, low: Math.min(...shown), high: Math.max(...shown) };
}
