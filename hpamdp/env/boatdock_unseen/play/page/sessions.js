"use strict";
// Sessions of trips with a boat that the player does not know. What the keys do is shown when the session is over.

playGame((game, tools) => {
  const { data, mean, share, withMinus, percent, swatch, COLOURS } = tools;
  const rules = data.session_rules;
  const NAMES = ["first", "second"];
  const FAMILIES = {
    turned: "Their directions lie 120° apart.",
    any: `Their directions lie at least ${rules.separation}° apart. Some docks cannot be reached.`,
    strength: `Their directions lie 120° apart. Speed and glide are up to ${percent(rules.spread)} below or above the usual ones.`,
  };

  // Pages that are loaded one after another begin with different boats.
  let number = parseInt(game.player.slice(0, 8), 16) % data.sessions.length;
  let begun = 1; // sessions on this page
  let trips = []; // those of this session that have ended
  let isAgreed = true; // whether the player agreed during all of them
  game.results = { session: [] };
  game.session = data.sessions[number];
  const isOver = () => trips.length === rules.trips;

  function nextSession() {
    number = (number + 1) % data.sessions.length;
    begun += 1;
    trips = [];
    isAgreed = true;
    game.session = data.sessions[number];
  }

  // Somebody who left a trip could sail it again and know more than was recorded, so the whole session is given up.
  function leave() {
    game.results.session.length -= trips.length;
    nextSession();
  }

  function status() {
    if (game.screen === "end") return "";
    const trip = trips.length + (game.screen === "result" ? 0 : 1);
    const last = trips.length ? `; last score ${withMinus(trips.at(-1).score)}` : "";
    return `Session ${begun}, trip ${trip} of ${rules.trips}${last}`;
  }

  function next() {
    if (isOver()) nextSession();
    const layout = game.session.trips[trips.length];
    return rules.boats === 1 ? { layout, text: "", onlyBoat: "0" } : { layout, text: "Choose a boat for this trip." };
  }

  function sailText(name) {
    const which = rules.boats === 1 ? "The boat is" : `The ${NAMES[name]} boat. Both are`;
    return trips.length ? `${which} the same as on the last trip.` : `${which} new.`;
  }

  function add(result) {
    trips.push({ boat: Number(result.boat), ...tools.sailed(result) });
    isAgreed &&= tools.hasAgreed();
    Object.assign(result, { trip: trips.length, best: game.layout.best });
  }

  function record() {
    return isOver() && isAgreed ? { rules, boats: game.session.boats, trips } : null;
  }

  function describe(result) {
    const own = `<p>${swatch(COLOURS.you, "solid")}You: <b>${withMinus(result.score)}</b>, ${percent(result.fuel)} fuel left</p>`;
    if (!isOver()) return own;
    const best = mean(game.session.trips.map((trip) => trip.best));
    return `${own}<h3>The session is over</h3><p>Your mean score: <b>${withMinus(mean(trips.map((trip) => trip.score)))}</b>. ` +
      `The best plans, which know the boat: ${withMinus(best)}.</p>${game.session.boats.map(revealed).join("")}`;
  }

  function revealed(boat, i) {
    const which = rules.boats === 1 ? "The keys" : `The keys of the ${NAMES[i]} boat`;
    const power = rules.family === "strength"
      ? `; its speed was ${percent(boat.strength)} and its glide ${percent(boat.glide)} of the usual ones` : "";
    return `<p>${which} pushed like this${power}:</p>${tools.picture(tools.compass(boat.directions)).outerHTML}`;
  }

  function byTrip(results) {
    const numbers = Array.from({ length: rules.trips }, (_, i) => i + 1);
    return numbers.map((trip) => [trip, results.filter((result) => result.trip === trip)]).filter(([, own]) => own.length);
  }

  const table = (results) => tools.tableOf("Mean score by number of the trip", ["trip", "you", "trips", "best plans*"],
    byTrip(results).map(([trip, own]) => ["", trip, withMinus(mean(own.map((r) => r.score))), own.length,
      withMinus(mean(own.map((r) => r.best)))])) + (results.length ? "<tfoot><tr><td colspan=4>* know the boat</td></tr></tfoot>" : "");

  function curve(results) {
    const means = (of) => byTrip(results).map(([trip, own]) => [trip, mean(own.map((r) => r[of]))]);
    return {
      axis: "trip", total: rules.trips, dots: results.map((r) => [r.trip, r.score]), levels: [],
      curves: [
        { values: means("best"), colour: "#2b2b2b", text: "knowing the boat", thickness: 1.3 },
        { values: means("score"), colour: COLOURS.you, text: "you", thickness: 3 },
      ],
    };
  }

  function endText() {
    const { session } = game.results;
    return `${session.length} ${session.length === 1 ? "trip" : "trips"}, ` +
      `mean score ${withMinus(mean(session.map((r) => r.score)))}, ${percent(share(session))} docked.`;
  }

  const boats = rules.boats === 1 ? "a boat that you do not know" : "two boats that you do not know; you choose one for each trip";
  document.querySelector("#session-text").textContent =
    `A session has ${rules.trips} ${rules.trips === 1 ? "trip" : "trips"} with ${boats}. Each trip shows a boat and a dock in a ` +
    `round harbour. The next session has ${rules.boats === 1 ? "another boat" : "other boats"}. If you leave during a trip, its session does not count. ` +
    "A session is recorded only if you agree before its first trip.";
  document.querySelector("#family-text").textContent = FAMILIES[rules.family];
  document.querySelector("#press-text").textContent = `A press lasts at least ${rules.shortest_press} s.`;

  return {
    noun: "session", showsDirections: false, begin: () => {}, status, next, add, record, compare: () => {}, describe,
    tracks: () => [], isPause: isOver, isDone: () => false, endText, table, curve, boat: (name) => game.session.boats[name], sailText, leave,
  };
});
