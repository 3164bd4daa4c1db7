"use strict";
// The boat's motion and the rules of the game, in closed form. The functions are those of `hpamdp.env.boatdock.physics`
// and `hpamdp.env.boatdock.play.replay`, and a test compares them. The constants come from Python (`data.js`).
// Lengths are px from the harbour's centre (y down), times are seconds.

function makePhysics(rules) {
  const GLIDE = rules.glide;
  const OUTCOMES = { sailing: "sailing", success: "success", tooFast: "too_fast", out: "out_of_bounds" };
  const DRY = 1e-6;
  const SHORTEST = rules.shortest_press || 0;
  const LONGEST = rules.longest_press || Infinity;

  const speed = (t) => t * t * (100 - (20 / 3) * t);
  const pressedDistance = (t) => t * t * t * (100 / 3 - (5 / 3) * t);

  function durationFor(distance) {
    const d = Math.max(distance, 0);
    const root = Math.pow((3 / 100) * d + 1e-12, 1 / 3);
    let t = root * (1 + root / 60);
    for (let i = 0; i < 3; i++) t -= (pressedDistance(t) - d) / speed(t);
    return Math.max(t, 0);
  }

  // Distance covered `elapsed` seconds after the beginning of a press of `duration` seconds. `strength` is a factor of a
  // boat's speed, `glide` one of the length and the duration of its glide; both are 1 for people's boats.
  function distanceAt(duration, elapsed, strength = 1, glide = 1) {
    const pressed = pressedDistance(Math.max(Math.min(elapsed, duration), 0));
    if (elapsed <= duration) return strength * pressed;
    const stretch = GLIDE * glide;
    const virtual = Math.max(duration - (elapsed - duration) / stretch, 0);
    return strength * (pressed + stretch * (pressed - pressedDistance(virtual)));
  }

  function speedAt(duration, elapsed, strength, glide) {
    if (elapsed <= duration) return strength * speed(Math.max(elapsed, 0));
    return strength * speed(Math.max(duration - (elapsed - duration) / (GLIDE * glide), 0));
  }

  function timeAt(duration, distance, strength = 1, glide = 1) {
    const pressed = pressedDistance(duration);
    const way = distance / strength;
    if (way <= pressed) return Math.min(durationFor(way), duration);
    const stretch = GLIDE * glide;
    const virtual = Math.min(durationFor(pressed - (way - pressed) / stretch), duration);
    return duration + stretch * (duration - virtual);
  }

  function distanceToDock(x, y, goal, dir) {
    const ahead = (goal[0] - x) * dir[0] + (goal[1] - y) * dir[1];
    const aside = (goal[0] - x) * dir[1] - (goal[1] - y) * dir[0];
    const square = rules.dock_radius ** 2 - aside * aside;
    if (square < 0 || ahead <= 0) return Infinity;
    return Math.max(ahead - Math.sqrt(square), 0);
  }

  function distanceToHarbour(x, y, dir) {
    const ahead = x * dir[0] + y * dir[1];
    const aside = x * dir[1] - y * dir[0];
    return Math.max(Math.sqrt(Math.max(rules.harbour_radius ** 2 - aside * aside, 0)) - ahead, 0);
  }

  // One press from rest up to the first event: the final position, the fuel left, the distance and the outcome.
  function press(x, y, fuel, goal, dir, wanted, strength = 1, glide = 1) {
    const duration = Math.min(wanted, fuel);
    const pressed = strength * pressedDistance(duration);
    const stretch = GLIDE * glide;
    const total = (1 + stretch) * pressed;
    const toDock = distanceToDock(x, y, goal, dir);
    const toHarbour = distanceToHarbour(x, y, dir);
    const docks = toDock <= total && toDock <= toHarbour;
    const leaves = toHarbour < total && !docks;
    const travelled = docks ? toDock : leaves ? toHarbour : total;
    const inGlide = travelled > pressed;
    const virtual = Math.min(durationFor((inGlide ? (total - travelled) / stretch : travelled) / strength), duration);
    const burnt = inGlide ? duration : virtual;
    let left = fuel - burnt;
    if (!(left > DRY)) left = 0;
    let outcome = left > 0 ? OUTCOMES.sailing : "out_of_fuel";
    if (docks) outcome = strength * speed(virtual) <= rules.docking_speed ? OUTCOMES.success : OUTCOMES.tooFast;
    else if (leaves) outcome = OUTCOMES.out;
    return { x: x + travelled * dir[0], y: y + travelled * dir[1], fuel: left, outcome, travelled, duration,
      arrival: strength * speed(virtual) };
  }

  // The presses that follow from raw key events. A press ends with the release of its key, the next key or a blur. If
  // the rules have a shortest press, a key that is released earlier stays down until then.
  function settle(events) {
    const presses = [];
    let key = -1;
    let begun = 0;
    const close = (time) => {
      if (key < 0 || time <= begun) return;
      presses.push({ key, start: begun, duration: Math.min(Math.max(time - begun, SHORTEST), LONGEST) });
    };
    for (const event of events) {
      if (event.type === "down") {
        close(event.t);
        key = event.key;
        begun = presses.length ? Math.max(event.t, presses[presses.length - 1].start + SHORTEST) : event.t;
      } else if (event.type === "blur" || event.key === key) {
        close(event.t);
        key = -1;
      }
    }
    close(Infinity);
    return presses.slice(0, rules.max_presses);
  }

  // The boat at the time `now`, given the settled presses. `now = Infinity` plays to the end.
  // A boat has the `directions` of its keys, and may have a `strength` and a `glide`.
  function sail(layout, { directions, strength = 1, glide = 1 }, presses, now) {
    let [x, y] = layout.start;
    let fuel = rules.tank;
    const legs = [];
    const used = [];
    let state = { outcome: OUTCOMES.sailing, ended: 0, speed: 0, heading: null, isPressed: false };
    for (let i = 0; i < presses.length && state.outcome === OUTCOMES.sailing; i++) {
      const { key, start } = presses[i];
      if (start > now) break;
      const dir = directions[key];
      const whole = press(x, y, fuel, layout.goal, dir, presses[i].duration, strength, glide);
      const seconds = timeAt(whole.duration, whole.travelled, strength, glide);
      const isLast = whole.outcome === "out_of_fuel" || i + 1 === rules.max_presses;
      const following = i + 1 < presses.length ? presses[i + 1].start : Infinity;
      const isCut = following - start < seconds && !isLast;
      const until = isCut ? following : start + seconds;
      const origin = [x, y];
      if (now < until) { // under way
        const elapsed = now - start;
        const way = Math.min(distanceAt(whole.duration, elapsed, strength, glide), whole.travelled);
        x += way * dir[0];
        y += way * dir[1];
        fuel -= Math.min(elapsed, whole.duration);
        state = { ...state, heading: dir, speed: speedAt(whole.duration, elapsed, strength, glide), isPressed: elapsed < whole.duration };
        legs.push({ from: origin, to: [x, y], pressed: Math.min(way, strength * pressedDistance(whole.duration)), way });
        break;
      }
      const way = isCut ? distanceAt(whole.duration, following - start, strength, glide) : whole.travelled;
      const burnt = isCut ? whole.duration : fuel - whole.fuel;
      used.push({ key, start, duration: burnt });
      [x, y] = isCut ? [x + way * dir[0], y + way * dir[1]] : [whole.x, whole.y];
      fuel = isCut ? fuel - whole.duration : whole.fuel;
      legs.push({ from: origin, to: [x, y], pressed: Math.min(way, strength * pressedDistance(burnt)), way });
      state = { outcome: OUTCOMES.sailing, ended: until, speed: 0, heading: dir, isPressed: false };
      if (!isCut) {
        const isOutOfTime = whole.outcome === OUTCOMES.sailing && i + 1 === rules.max_presses;
        state.outcome = isOutOfTime ? "time_limit" : whole.outcome;
        if (state.outcome !== OUTCOMES.sailing) state.speed = whole.arrival;
      }
    }
    return { ...state, x, y, fuel, legs, presses: used };
  }

  const score = (outcome, fuel) => (outcome === OUTCOMES.success ? (5 * fuel) / rules.tank : -1);

  return { speed, pressedDistance, durationFor, distanceAt, timeAt, press, settle, sail, score };
}

if (typeof module !== "undefined") module.exports = { makePhysics };
