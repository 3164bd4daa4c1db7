"use strict";
// The agents in the page: matrix products on weights from `data.js`. `hpamdp.policies.shared.exported_policy` explains
// their form. An agent acts greedily, and each of its presses ends at rest.

function makeAgents(data, physics) {
  const { rules } = data;
  const TOP_SPEED = physics.speed(rules.max_duration);

  function floats(text) {
    const bytes = Uint8Array.from(atob(text), (char) => char.charCodeAt(0));
    return new Float32Array(bytes.buffer);
  }

  const decodeLayer = (layer) => ({ ...layer, weight: floats(layer.weight), bias: floats(layer.bias) });

  function apply(layer, x) {
    const y = new Array(layer.out);
    for (let i = 0; i < layer.out; i++) {
      let sum = layer.bias[i];
      for (let j = 0; j < layer.in; j++) sum += layer.weight[i * layer.in + j] * x[j];
      y[i] = sum;
    }
    return y;
  }

  const relu = (x) => x.map((value) => Math.max(value, 0));
  const argmax = (x) => x.indexOf(Math.max(...x));
  const clip = (value) => Math.min(Math.max(value, -1), 1);

  function makeLearner(form) {
    const encoder = form.encoder.map(decodeLayer);
    const discrete = decodeLayer(form.discrete);
    const parameters = decodeLayer(form.parameters);
    return (observation) => {
      const hidden = encoder.reduce((x, layer) => relu(apply(layer, x)), observation);
      const key = argmax(apply(discrete, hidden));
      const unit = clip(apply(parameters, hidden)[key]);
      return { key, duration: form.low[key] + (unit + 1) * 0.5 * (form.high[key] - form.low[key]) };
    };
  }

  const product = (row, features) => row.reduce((sum, c, i) => sum + c * features[i], 0);

  function makeSelector(form) {
    if (form.kind === "projections") {
      const features = (observation, directions) => form.vectors.flatMap(([i, j], number) => {
        const [x, y] = [observation[i] - form.origins[number][0], observation[j] - form.origins[number][1]];
        const along = (action) => x * directions[action][0] + y * directions[action][1];
        return form.kinds.flatMap((actions) => actions.map(along).sort((one, other) => other - one));
      });
      return (observation) => argmax(form.coefficients.map((row, option) =>
        product(row, [...features(observation, form.directions[option]), 1])));
    }
    if (form.kind === "polynomial") {
      return (observation) => {
        const entries = [...form.inputs.map((i) => observation[i]), 1];
        const features = form.factors.map((factors) => factors.reduce((product, i) => product * entries[i], 1));
        return argmax(form.coefficients.map((row) => product(row, features)));
      };
    }
    const members = form.members.map((layers) => layers.map(decodeLayer));
    return (observation) => {
      const outputs = members.map((layers) =>
        layers.reduce((x, layer, i) => apply(layer, i ? relu(x) : x), observation));
      return argmax(outputs[0].map((_, option) => outputs.reduce((sum, output) => sum + output[option], 0)));
    };
  }

  // The scaled observation of BoatDockEnv.
  function observe(layout, boat, shownController) {
    const unit = 1 / rules.harbour_radius;
    const away = (x, y) => Math.hypot(layout.goal[0] - x, layout.goal[1] - y);
    const atStart = Math.max(away(...layout.start), rules.dock_radius);
    return [
      layout.start[0] * unit, layout.start[1] * unit, layout.goal[0] * unit, layout.goal[1] * unit, 0, 0, 1,
      shownController, boat.x * unit, boat.y * unit, boat.velocity[0] / TOP_SPEED, boat.velocity[1] / TOP_SPEED,
      boat.fuel / rules.tank, away(boat.x, boat.y) / atStart,
      (layout.goal[0] - boat.x) * unit, (layout.goal[1] - boat.y) * unit,
    ];
  }

  function sailPresses(layout, directions, nextPress) {
    let boat = { x: layout.start[0], y: layout.start[1], fuel: rules.tank, velocity: [0, 0] };
    const points = [[boat.x, boat.y]];
    const presses = [];
    let outcome = "sailing";
    while (outcome === "sailing") {
      const wanted = presses.length < rules.max_presses ? nextPress(boat, presses.length) : null;
      if (wanted === null) {
        outcome = "time_limit";
        break;
      }
      const dir = directions[wanted.key];
      const duration = Math.min(Math.max(wanted.duration, 0), rules.max_duration);
      const after = physics.press(boat.x, boat.y, boat.fuel, layout.goal, dir, duration);
      const speed = physics.speed(boat.fuel - after.fuel);
      boat = { x: after.x, y: after.y, fuel: after.fuel, velocity: [speed * dir[0], speed * dir[1]] };
      points.push([boat.x, boat.y]);
      presses.push({ key: wanted.key, duration });
      ({ outcome } = after);
    }
    return { points, presses, outcome, fuel: boat.fuel, score: physics.score(outcome, boat.fuel) };
  }

  const directionsOf = (controller, keymap) =>
    data.directions[controller === "congruent" ? "congruent" : `incongruent_${keymap}`];

  function makeAgent(entry) {
    const learners = entry.agent.learners.map(makeLearner);
    const select = entry.agent.selector ? makeSelector(entry.agent.selector) : null;
    const keymap = entry.keymap === 2 ? 2 : 1;
    const choose = (layout) => {
      if (entry.controller === "congruent") return 1;
      if (entry.controller === "incongruent" || select === null) return 0;
      const boat = { x: layout.start[0], y: layout.start[1], fuel: rules.tank, velocity: [0, 0] };
      return select(observe(layout, boat, -1));
    };
    const act = (layout, boat, option, number) => {
      const shown = select !== null && number === 0 ? -1 : option;
      const observation = observe(layout, boat, shown);
      if (entry.agent.is_shared) observation.push(option === 0 ? 1 : 0, option === 1 ? 1 : 0);
      return learners[learners.length === 1 ? 0 : option](observation);
    };
    const sail = (layout) => {
      const option = choose(layout);
      const controller = option === 1 ? "congruent" : "incongruent";
      const directions = directionsOf(controller, keymap);
      const sailed = sailPresses(layout, directions, (boat, number) => act(layout, boat, option, number));
      return { controller, ...sailed };
    };
    return { name: entry.name, title: entry.title, controller: entry.controller, choose, act, sail };
  }

  // The best plan of a boat. The keys of plans belong to key map 1.
  function sailPlan(layout, controller) {
    const plan = layout.best[controller];
    const sailed = sailPresses(layout, directionsOf(controller, 1), (boat, number) => plan.presses[number] || null);
    return { controller, ...sailed, planned: plan.score };
  }

  return { agents: data.agents.map(makeAgent), sailPlan, directionsOf };
}

if (typeof module !== "undefined") module.exports = { makeAgents };
