"use strict";
// People's task: two boats whose arrows are shown, beside agents and the best plans.

playGame((game, tools) => {
  const { data, mean, share, withMinus, percent, escape, swatch, colourOf, COLOURS } = tools;
  const { rules } = data;
  const crew = makeAgents(data, tools.physics);
  const MODES = { practice: "Practice", round: "Rounds", free: "Free play" };
  let keymap = 1;

  game.results = { practice: [], round: [], free: [] };
  const played = () => game.results[game.mode];
  const isDone = () => game.mode !== "free" && played().length >= data.layouts[game.mode].length;
  const titles = distinctTitles(data.agents);

  // The titles of agents. If titles are equal, they also have the agents' names; if these are equal, too, a number.
  function distinctTitles(agents) {
    const isRepeated = (text, i, all) => all.indexOf(text) !== i || all.lastIndexOf(text) !== i;
    return agents.map((agent) => agent.title + (agent.controller === "choose" ? "" : `, ${agent.controller}`))
      .map((title, i, all) => (isRepeated(title, i, all) ? `${title} (${agents[i].name})` : title))
      .map((title, i, all) => (isRepeated(title, i, all) ? `${title}, ${i + 1}` : title));
  }

  function begin(mode) {
    keymap = Number(document.querySelector("input[name=keymap]:checked").value);
    if (isDone()) game.results[mode] = [];
  }

  function status() {
    const number = played().length + (game.screen === "result" || game.screen === "end" ? 0 : 1);
    if (game.mode === "free") return `Free play, episode ${number}`;
    if (game.mode === "practice") return `Practice, episode ${number} of ${data.layouts.practice.length}`;
    const inBlock = ((number - 1) % rules.block) + 1;
    return `Round ${Math.floor((number - 1) / rules.block) + 1} of ${rules.num_blocks}, episode ${inBlock} of ${rules.block}`;
  }

  function next() {
    const layouts = data.layouts[game.mode];
    const text = "Choose a boat. The arrows show where its keys push it.";
    return { layout: layouts[played().length % layouts.length], text };
  }

  function add(result) {
    const { congruent, incongruent } = game.layout.best;
    const better = congruent.score >= incongruent.score ? "congruent" : "incongruent";
    Object.assign(result, { controller: result.boat, best: game.layout.best[better].score, better });
  }

  function compare(result) {
    const { layout } = game;
    const agents = crew.agents.map((agent) => agent.sail(layout));
    Object.assign(result, { agents, plan: crew.sailPlan(layout, result.better) });
  }

  const record = (result) => ({ mode: game.mode, keymap, controller: result.controller, ...tools.sailed(result) });

  // The boat that an agent chose, which the title of an agent without a choice has already.
  const choiceOf = (i, sailed) => (data.agents[i].controller === "choose" ? `, ${sailed.controller}` : "");

  function describe(result) {
    const chosen = game.layout.people;
    return [
      `<p>${swatch(COLOURS.you, "solid")}You, ${result.controller}: <b>${withMinus(result.score)}</b>, ` +
        `${percent(result.fuel)} fuel left</p>`,
      `<p>${swatch(COLOURS.plan, "dashed")}Best plan, ${result.better}: ${withMinus(result.best)}</p>`,
      ...result.agents.map((sailed, i) =>
        `<p>${swatch(colourOf(i), "solid")}${escape(titles[i])}${choiceOf(i, sailed)}: ${withMinus(sailed.score)}</p>`),
      `<p>People at this bearing: ${percent(chosen)} chose the congruent boat, ${percent(1 - chosen)} the incongruent one.</p>`,
    ].join("");
  }

  const tracks = (result) => [
    ...result.agents.map((sailed, i) => ({ points: sailed.points, colour: colourOf(i), dashes: [] })),
    { points: result.plan.points, colour: COLOURS.plan, dashes: [3.5, 3.5] },
  ];

  function isPause() {
    const isBlock = game.mode === "round" && played().length % rules.block === 0;
    return isBlock || (game.mode === "practice" && isDone());
  }

  function endText(isStopped) {
    const results = played();
    let text = `${MODES[game.mode]}: ${results.length} episodes${isStopped || isDone() ? "" : " so far"}, ` +
      `mean score ${withMinus(mean(results.map((r) => r.score)))}, ${percent(share(results))} docked.`;
    if (game.mode === "round") {
      const blocks = data.people.success_by_block.map((people, i) => {
        const own = results.slice(i * rules.block, (i + 1) * rules.block);
        return own.length === rules.block ? `Round ${i + 1}: you docked ${percent(share(own))}, people ${percent(people)}.` : "";
      });
      text += ` ${blocks.filter(Boolean).join(" ")}`;
    }
    return text;
  }

  function table(results) {
    const has = results.length > 0;
    const meansOf = (own) => (has ? [withMinus(mean(own.map((r) => r.score))), percent(share(own))] : ["", ""]);
    return tools.tableOf("Means; agents and ceiling on your layouts", ["", "score", "docked"], [
      ["you", `You, ${results.length} ${results.length === 1 ? "episode" : "episodes"}`, ...meansOf(results)],
      ["", "People, mean", withMinus(data.people.mean), percent(data.people.success)],
      ["", "Best of 40 people", withMinus(data.people.best), percent(data.people.best_success)],
      ...titles.map((title, i) => ["", escape(title), ...meansOf(results.map((r) => r.agents[i]))]),
      ["", "Ceiling", has ? withMinus(mean(results.map((r) => r.best))) : "", has ? "100 %" : ""],
    ]);
  }

  function curve(results) {
    const window_ = Math.max(1, Math.min(10, Math.floor(results.length / 3)));
    const scores = results.map((r) => r.score);
    const smooth = scores.map((_, i) => [i + 1, mean(scores.slice(Math.max(0, i - window_ + 1), i + 1))]);
    return {
      axis: "episode", total: results.length, dots: scores.map((score, i) => [i + 1, score]),
      curves: [{ values: smooth, colour: COLOURS.you, text: `you${window_ > 1 ? `, last ${window_}` : ""}`, thickness: 3 }],
      levels: [
        { value: mean(results.map((r) => r.best)), colour: "#2b2b2b", text: "ceiling", dashes: [] },
        { value: data.people.mean, colour: "#D98200", text: "people", dashes: [6, 4] },
        { value: data.people.best, colour: "#D98200", text: "best person", dashes: [2, 3] },
        ...titles.map((text, i) =>
          ({ value: mean(results.map((r) => r.agents[i].score)), colour: colourOf(i), text, dashes: [] })),
      ],
    };
  }

  return {
    noun: "episode", showsDirections: true, begin, status, next, add, record, compare, describe, tracks, isPause, isDone, endText,
    table, curve, boat: (name) => ({ directions: crew.directionsOf(name, keymap) }),
    sailText: (name) => `The ${name} boat. Hold a key; release it to glide.`, leave: () => {},
  };
});
