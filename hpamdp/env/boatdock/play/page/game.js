"use strict";
// The game: screens, keys and touches, the picture, the table and the curve. Key times come from the browser's events
// (`event.timeStamp`), not from the pictures. Every picture is computed again from all events so far. So an event that
// the browser reports late still counts from the time when it happened.

(function () {
  const data = window.HPAMDP_DATA;
  const { rules } = data;
  const physics = makePhysics(rules);
  const crew = makeAgents(data, physics);

  const LATE = 0.12; // s for which the end of an episode waits for earlier events that are reported late
  const LONGEST = 3600; // s
  const KEYS = {
    Digit1: 0, Numpad1: 0, KeyJ: 0, ArrowLeft: 0,
    Digit2: 1, Numpad2: 1, KeyK: 1, ArrowUp: 1, ArrowDown: 1,
    Digit3: 2, Numpad3: 2, KeyL: 2, ArrowRight: 2,
  };
  const COLOURS = { you: "#1d3f58", glide: "#86aecb", plan: "#3c8a55", agents: ["#D55E00", "#AA4499", "#0072B2", "#8c6d1f"] };
  const OUTCOMES = {
    success: "Docked", too_fast: "Too fast", out_of_bounds: "Out of the harbour", out_of_fuel: "Out of fuel",
    time_limit: `${rules.max_presses} presses and no dock`,
  };
  const MODES = { practice: "Practice", round: "Rounds", free: "Free play" };

  const $ = (selector) => document.querySelector(selector);
  const harbour = $("#harbour");
  const game = {
    screen: "loading", mode: null, keymap: 1, number: 0, layout: null, controller: null, origin: 0, events: [],
    state: null, results: { practice: [], round: [], free: [] }, stored: [], unsent: [], sent: 0, refused: 0, downloaded: 0,
    player: null, resolution: 0,
  };
  window.hpamdpGame = game;

  // ---- screens ----

  function show(screen) {
    game.screen = screen;
    document.body.dataset.screen = screen;
    $("#welcome").hidden = screen !== "start";
    $("#game").hidden = !["choose", "sail", "result"].includes(screen);
    $("#end").hidden = screen !== "end";
    window.scrollTo(0, 0);
    $("#status").textContent = screen === "start" ? "" : statusText();
  }

  function statusText() {
    const number = game.results[game.mode].length + (game.screen === "result" || game.screen === "end" ? 0 : 1);
    if (game.mode === "free") return `Free play, episode ${number}`;
    if (game.mode === "practice") return `Practice, episode ${number} of ${data.layouts.practice.length}`;
    const inBlock = ((number - 1) % rules.block) + 1;
    return `Round ${Math.floor((number - 1) / rules.block) + 1} of ${rules.num_blocks}, episode ${inBlock} of ${rules.block}`;
  }

  function begin(mode) {
    game.mode = mode;
    game.keymap = Number($("input[name=keymap]:checked").value);
    if (mode !== "free" && game.results[mode].length >= data.layouts[mode].length) game.results[mode] = [];
    choose();
  }

  function choose() {
    const layouts = data.layouts[game.mode];
    game.layout = layouts[game.results[game.mode].length % layouts.length];
    game.controller = null;
    game.state = null;
    show("choose");
    $("#result").innerHTML = "<p>Choose a boat. The arrows show where its keys push it.</p>";
    for (const card of document.querySelectorAll(".boat")) {
      card.querySelector("svg").replaceChildren(...compass(crew.directionsOf(card.dataset.boat, game.keymap)));
    }
    fillTable($("#table"));
    setGauges(rules.tank, 0);
    draw();
  }

  function sail(controller, time) {
    game.controller = controller;
    game.origin = time;
    game.events = [];
    show("sail");
    const directions = crew.directionsOf(controller, game.keymap);
    document.querySelectorAll(".key").forEach((button, key) => {
      const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
      svg.setAttribute("viewBox", "-50 -50 100 100");
      svg.append(arrow(directions[key], -32, 32));
      button.replaceChildren(document.createTextNode(String(key + 1)), svg);
      button.setAttribute("aria-label", `key ${key + 1}`);
    });
    $("#result").innerHTML = `<p>The ${controller} boat. Hold a key; release it to glide.</p>`;
    requestAnimationFrame(frame);
  }

  // ---- events ----

  function note(type, key, code, time) {
    if (game.screen !== "sail") return;
    const last = game.events.length ? game.events[game.events.length - 1].t : 0;
    // The browser may report events of different kinds out of order.
    const t = Math.max((time - game.origin) / 1000, last);
    if (t > LONGEST) return leaveOpen();
    if (game.events.length >= 1990) return;
    game.events.push({ t, type, key, code });
  }

  // The check of episodes allows at most an hour. A longer episode starts again, with the choice of a boat.
  function leaveOpen() {
    choose();
    $("#result").innerHTML = "<p>This episode was open for more than an hour. Choose a boat to start it again.</p>";
  }

  function releaseAll(event) {
    if (game.screen === "sail" && game.events.length) note("blur", -1, "", event.timeStamp);
    document.querySelectorAll(".key.down").forEach((button) => button.classList.remove("down"));
  }

  window.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (game.screen === "sail" && event.code in KEYS) {
      event.preventDefault();
      if (event.repeat) return;
      note("down", KEYS[event.code], event.code, event.timeStamp);
      keyButton(KEYS[event.code]).classList.add("down");
    } else if (game.screen === "choose" && !event.repeat && (event.code === "KeyC" || event.code === "KeyI")) {
      sail(event.code === "KeyC" ? "congruent" : "incongruent", event.timeStamp);
    } else if (game.screen === "result" && !event.repeat && (event.code === "Enter" || event.code === "Space")) {
      if (event.target.closest("button:not(#next)")) return; // the focused button handles the key itself
      event.preventDefault();
      next();
    }
  });
  window.addEventListener("keyup", (event) => {
    if (!(event.code in KEYS)) return;
    note("up", KEYS[event.code], event.code, event.timeStamp);
    keyButton(KEYS[event.code]).classList.remove("down");
  });
  window.addEventListener("blur", releaseAll);
  document.addEventListener("visibilitychange", (event) => document.hidden && releaseAll(event));

  const keyButton = (key) => document.querySelector(`.key[data-key="${key}"]`);
  for (const button of document.querySelectorAll(".key")) {
    const key = Number(button.dataset.key);
    button.addEventListener("pointerdown", (event) => {
      event.preventDefault();
      button.setPointerCapture(event.pointerId);
      note("down", key, "pointer", event.timeStamp);
      button.classList.add("down");
    });
    for (const type of ["pointerup", "pointercancel"]) {
      button.addEventListener(type, (event) => {
        note("up", key, "pointer", event.timeStamp);
        button.classList.remove("down");
      });
    }
    button.addEventListener("contextmenu", (event) => event.preventDefault());
  }
  for (const card of document.querySelectorAll(".boat")) {
    card.addEventListener("click", (event) => game.screen === "choose" && sail(card.dataset.boat, event.timeStamp));
  }
  for (const button of document.querySelectorAll("[data-mode]")) {
    button.addEventListener("click", () => begin(button.dataset.mode));
  }
  $("#next").addEventListener("click", next);
  $("#finish").addEventListener("click", () => end(true));
  $("#again").addEventListener("click", () => show("start"));
  $("#go-on").addEventListener("click", choose);
  $("#download").addEventListener("click", download);

  // ---- an episode ----

  function frame(now) {
    if (game.screen !== "sail") return;
    const last = game.events.length ? game.events[game.events.length - 1].t : 0;
    const time = Math.max((now - game.origin) / 1000, last, 0);
    const directions = crew.directionsOf(game.controller, game.keymap);
    game.state = physics.sail(game.layout, directions, physics.settle(game.events), time);
    setGauges(game.state.fuel, game.state.speed);
    draw();
    if (game.state.outcome !== "sailing" && time > game.state.ended + LATE) finish();
    else requestAnimationFrame(frame);
  }

  function finish() {
    const { layout, state } = game;
    const best = Math.max(layout.best.congruent.score, layout.best.incongruent.score);
    const better = layout.best.congruent.score >= layout.best.incongruent.score ? "congruent" : "incongruent";
    const result = {
      controller: game.controller, outcome: state.outcome, fuel: state.fuel / rules.tank,
      score: physics.score(state.outcome, state.fuel), best, better,
      agents: crew.agents.map((agent) => agent.sail(layout)),
      plan: crew.sailPlan(layout, better),
    };
    game.results[game.mode].push(result);
    record(result);
    document.querySelectorAll(".key.down").forEach((button) => button.classList.remove("down"));
    show("result");
    describe(result);
    fillTable($("#table"));
    draw(result);
    $("#next").focus({ preventScroll: true });
  }

  function next() {
    if (game.screen !== "result") return;
    const played = game.results[game.mode].length;
    const isBlock = game.mode === "round" && played % rules.block === 0;
    if (isBlock || (game.mode === "practice" && played >= data.layouts.practice.length)) end(false);
    else choose();
  }

  function end(isStopped) {
    const results = game.results[game.mode];
    const isDone = game.mode !== "free" && results.length >= data.layouts[game.mode].length;
    if (!results.length) return show("start");
    show("end");
    $("#go-on").hidden = isDone;
    $("#download").disabled = game.stored.length === 0;
    $("#download").title = game.stored.length ? "" : "Nothing was recorded, because you did not agree at the start";
    $("#end-text").textContent = `${MODES[game.mode]}: ${results.length} episodes${isStopped || isDone ? "" : " so far"}, ` +
      `mean score ${mean(results.map((r) => r.score)).toFixed(2)}, ${percent(share(results))} docked.`;
    if (game.mode === "round") {
      const blocks = data.people.success_by_block.map((people, i) => {
        const own = results.slice(i * rules.block, (i + 1) * rules.block);
        return own.length === rules.block ? `Round ${i + 1}: you docked ${percent(share(own))}, people ${percent(people)}.` : "";
      });
      $("#end-text").textContent += ` ${blocks.filter(Boolean).join(" ")}`;
    }
    drawCurve(results);
    fillTable($("#end-table"));
  }

  // ---- what is kept ----

  function record(result) {
    if (!$("#consent").checked) return;
    const { state, layout } = game;
    const episode = {
      format: data.format, software: data.software, consent: true, player: game.player, index: game.stored.length,
      mode: game.mode, keymap: game.keymap, controller: game.controller, start: layout.start, goal: layout.goal,
      events: game.events.map((event) => ({ ...event })), presses: state.presses, outcome: state.outcome,
      fuel: result.fuel, score: result.score, end: [state.x, state.y], resolution: game.resolution,
    };
    game.stored.push(episode);
    if (data.has_server) {
      game.unsent.push(episode);
      send();
    }
  }

  let isSending = false;
  let isWaiting = false; // whether the notice says that episodes wait
  async function send() {
    if (isSending) return;
    isSending = true;
    try {
      while (game.unsent.length) {
        const body = JSON.stringify(game.unsent[0]);
        const answer = await fetch("episodes", { method: "POST", headers: { "Content-Type": "application/json" }, body });
        if (answer.status >= 500) throw new Error((await answer.text()).trim() || `the server answered ${answer.status}`);
        if (answer.ok) game.sent += 1;
        else {
          game.refused += 1;
          notice(`An episode was refused: ${await answer.text()}`);
        }
        game.unsent.shift();
      }
      if (isWaiting) notice("");
      isWaiting = false;
    } catch (error) {
      const num = game.unsent.length;
      notice(`${num} ${num === 1 ? "episode waits" : "episodes wait"} for the server (${error.message}). You can go on playing.`);
      isWaiting = true;
      setTimeout(send, 3000);
    } finally {
      isSending = false;
    }
  }

  function download() {
    const text = game.stored.map((episode) => `${JSON.stringify(episode)}\n`).join("");
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([text], { type: "application/x-ndjson" }));
    link.download = `episodes-${game.player}.jsonl`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000); // some browsers start reading only later
    game.downloaded = game.stored.length;
  }

  // Ask before the page closes if it holds the only copy of an episode.
  window.addEventListener("beforeunload", (event) => {
    if (data.has_server ? game.unsent.length : game.downloaded < game.stored.length) event.preventDefault();
  });

  const notice = (text) => { $("#notice").textContent = text; };

  // ---- what is shown ----

  const mean = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;
  const share = (results) => mean(results.map((r) => (r.outcome === "success" ? 1 : 0)));
  const cssPercent = (value) => `${100 * value}%`;
  const titleOf = (agent) => agent.title + (agent.controller === "choose" ? "" : `, ${agent.controller}`);
  const percent = (value) => `${(100 * value).toFixed(0)} %`;
  const colourOf = (i) => COLOURS.agents[i % COLOURS.agents.length];
  const swatch = (colour, dashes) => `<span class="swatch" style="border-color:${colour};border-top-style:${dashes}"></span>`;

  function describe(result) {
    const isGood = result.outcome === "success";
    const why = result.outcome === "too_fast"
      ? ` at ${game.state.speed.toFixed(0)} px/s; the limit is ${rules.docking_speed.toFixed(0)}` : "";
    const chosen = game.layout.people;
    const lines = [
      `<h3 class="${isGood ? "good" : "bad"}">${OUTCOMES[result.outcome]}${why}</h3>`,
      `<p>${swatch(COLOURS.you, "solid")}You, ${result.controller}: <b>${result.score.toFixed(2)}</b>, ` +
        `${percent(result.fuel)} fuel left</p>`,
      `<p>${swatch(COLOURS.plan, "dashed")}Best plan, ${result.better}: ${result.best.toFixed(2)}</p>`,
      ...result.agents.map((sailed, i) =>
        `<p>${swatch(colourOf(i), "solid")}${escape(data.agents[i].title)}, ${sailed.controller}: ${sailed.score.toFixed(2)}</p>`),
      `<p>People at this bearing: ${percent(chosen)} chose the congruent boat, ${percent(1 - chosen)} the incongruent one.</p>`,
    ];
    $("#result").innerHTML = lines.join("");
  }

  function fillTable(table) {
    const results = game.results[game.mode];
    const rows = [];
    const has = results.length > 0;
    const write = (value) => (has ? value.toFixed(2) : "");
    rows.push(["you", `You, ${results.length} ${results.length === 1 ? "episode" : "episodes"}`,
      has ? write(mean(results.map((r) => r.score))) : "", has ? percent(share(results)) : ""]);
    rows.push(["", "People, mean", data.people.mean.toFixed(2), percent(data.people.success)]);
    rows.push(["", "Best of 40 people", data.people.best.toFixed(2), percent(data.people.best_success)]);
    data.agents.forEach((agent, i) => {
      const own = results.map((r) => r.agents[i]);
      rows.push(["", escape(titleOf(agent)), has ? write(mean(own.map((r) => r.score))) : "", has ? percent(share(own)) : ""]);
    });
    rows.push(["", "Ceiling", has ? write(mean(results.map((r) => r.best))) : "", has ? "100 %" : ""]);
    table.innerHTML = "<caption>Means; agents and ceiling on your layouts</caption>" +
      "<tr><th></th><th>score</th><th>docked</th></tr>" +
      rows.map(([kind, ...cells]) => `<tr class="${kind}">${cells.map((c) => `<td>${c}</td>`).join("")}</tr>`).join("");
  }

  const escape = (text) => text.replace(/[&<>"]/g, (c) => ({ "&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;" }[c]));

  function setGauges(fuel, speed) {
    const left = fuel / rules.tank;
    const scale = 3 * rules.docking_speed; // px/s at the right end of the bar
    $("#fuel i").style.width = cssPercent(left);
    $("#fuel i").className = left < 0.25 ? "low" : "";
    $("#fuel-text").textContent = `${fuel.toFixed(2)} s`;
    $("#speed i").style.width = cssPercent(Math.min(speed / scale, 1));
    $("#speed i").className = speed > rules.docking_speed ? "low" : "";
    $("#speed em").style.left = cssPercent(rules.docking_speed / scale);
    $("#speed-text").textContent = speed > rules.docking_speed ? "too fast" : `${speed.toFixed(0)} px/s`;
  }

  // ---- drawing ----

  function arrow(dir, from, to, label) {
    const group = document.createElementNS("http://www.w3.org/2000/svg", "g");
    const path = document.createElementNS("http://www.w3.org/2000/svg", "path");
    const [x, y] = dir;
    const tip = [to * x, to * y];
    const side = (s) => `${tip[0] - 11 * x - 8 * s * y} ${tip[1] - 11 * y + 8 * s * x}`;
    path.setAttribute("d", `M${from * x} ${from * y}L${tip[0]} ${tip[1]}M${side(1)}L${tip[0]} ${tip[1]}L${side(-1)}`);
    path.setAttribute("class", "arrow");
    group.append(path);
    if (label) {
      const text = document.createElementNS("http://www.w3.org/2000/svg", "text");
      text.setAttribute("x", (to + 11) * x);
      text.setAttribute("y", (to + 11) * y);
      text.textContent = label;
      group.append(text);
    }
    return group;
  }

  const compass = (directions) => directions.map((dir, key) => arrow(dir, 6, 30, String(key + 1)));

  function draw(result) {
    const pixels = Math.round((harbour.clientWidth || 480) * (window.devicePixelRatio || 1));
    if (harbour.width !== pixels) harbour.width = harbour.height = pixels;
    const pen = harbour.getContext("2d");
    const scale = pixels / (2 * (rules.harbour_radius + 4));
    pen.setTransform(scale, 0, 0, scale, pixels / 2, pixels / 2);
    pen.clearRect(-200, -200, 400, 400);
    pen.lineCap = "round";
    pen.lineJoin = "round";
    disc(pen, [0, 0], rules.harbour_radius, "#d6e7ec", "#a5c2cb", 1.6);
    const { layout, state } = game;
    const outcome = state ? state.outcome : "sailing";
    const dock = outcome === "sailing" ? ["#f4dfb0", "#c8963e"] : outcome === "success" ? ["#c3e3c6", "#3c8a55"] : ["#f1cbbd", "#b9503a"];
    disc(pen, layout.goal, rules.dock_radius, dock[0], dock[1], 0.9);
    disc(pen, layout.goal, 1.6, dock[1]);
    if (result) {
      result.agents.forEach((sailed, i) => track(pen, sailed.points, colourOf(i), []));
      track(pen, result.plan.points, COLOURS.plan, [3.5, 3.5]);
    }
    if (state) {
      for (const leg of state.legs) {
        const at = leg.way > 0 ? leg.pressed / leg.way : 0;
        const release = [leg.from[0] + at * (leg.to[0] - leg.from[0]), leg.from[1] + at * (leg.to[1] - leg.from[1])];
        line(pen, release, leg.to, COLOURS.glide, 1.1, []);
        line(pen, leg.from, release, COLOURS.you, 1.9, []);
      }
    }
    disc(pen, layout.start, 3, "#f6f4ef", "#2d3e48", 1.1);
    const boat = state ? [state.x, state.y] : layout.start;
    if (state && state.heading) hull(pen, boat, state.heading);
    else disc(pen, boat, 4, "#1d3f58", "#f6f4ef", 0.9);
  }

  function disc(pen, [x, y], radius, fill, edge, width) {
    pen.beginPath();
    pen.arc(x, y, radius, 0, 2 * Math.PI);
    pen.fillStyle = fill;
    pen.fill();
    if (!edge) return;
    pen.setLineDash([]);
    pen.strokeStyle = edge;
    pen.lineWidth = width;
    pen.stroke();
  }

  function line(pen, from, to, colour, width, dashes) {
    pen.beginPath();
    pen.moveTo(...from);
    pen.lineTo(...to);
    pen.setLineDash(dashes);
    pen.strokeStyle = colour;
    pen.lineWidth = width;
    pen.stroke();
  }

  function track(pen, points, colour, dashes) {
    for (let i = 1; i < points.length; i++) {
      line(pen, points[i - 1], points[i], colour, 1.3, dashes);
      disc(pen, points[i], 1.7, colour);
    }
  }

  function hull(pen, [x, y], [dx, dy]) {
    const shape = [[7.8, 0], [4.5, 2.8], [0, 3.7], [-5.4, 3], [-5.4, -3], [0, -3.7], [4.5, -2.8]];
    pen.beginPath();
    for (const [f, s] of shape) pen.lineTo(x + f * dx - s * dy, y + f * dy + s * dx);
    pen.closePath();
    pen.fillStyle = "#1d3f58";
    pen.fill();
    pen.setLineDash([]);
    pen.strokeStyle = "#f6f4ef";
    pen.lineWidth = 0.9;
    pen.stroke();
    disc(pen, [x - 1.8 * dx, y - 1.8 * dy], 1.4, "#f6f4ef");
  }

  function drawCurve(results) {
    const canvas = $("#curve");
    const pen = canvas.getContext("2d");
    const ratio = window.devicePixelRatio || 1;
    const width = canvas.clientWidth || 720;
    const [height, left, right, top, bottom] = [Math.max(260, width / 2), 36, 150, 16, 34];
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.font = "13px system-ui, sans-serif";
    const total = Math.max(results.length, 2);
    const X = (n) => left + ((n - 1) / (total - 1)) * (width - left - right);
    const Y = (score) => top + ((5 - score) / 6) * (height - top - bottom);
    pen.textAlign = "right";
    for (let score = -1; score <= 5; score++) {
      line(pen, [left, Y(score)], [width - right, Y(score)], "#e8e4d8", 1, []);
      pen.fillStyle = "#7d8b92";
      pen.fillText(String(score), left - 8, Y(score) + 4);
    }
    pen.textAlign = "left";
    pen.fillText("episode", left, height - 10);
    pen.textAlign = "right";
    pen.fillText(String(results.length), width - right, height - 10);
    const window_ = Math.max(1, Math.min(10, Math.floor(results.length / 3)));
    const curve = (values) => values.map((_, i) => mean(values.slice(Math.max(0, i - window_ + 1), i + 1)));
    const labels = [];
    const level = (value, colour, text, dashes) => {
      line(pen, [left, Y(value)], [width - right, Y(value)], colour, 1.3, dashes);
      labels.push([Y(value), colour, `${text} ${value.toFixed(2)}`]);
    };
    level(mean(results.map((r) => r.best)), "#2b2b2b", "ceiling", []);
    level(data.people.mean, "#D98200", "people", [6, 4]);
    level(data.people.best, "#D98200", "best person", [2, 3]);
    data.agents.forEach((agent, i) => level(mean(results.map((r) => r.agents[i].score)), colourOf(i), titleOf(agent), []));
    results.forEach((r, i) => disc(pen, [X(i + 1), Y(r.score)], 2.5, "#9fb3c0"));
    const smooth = curve(results.map((r) => r.score));
    for (let i = 1; i < smooth.length; i++) {
      line(pen, [X(i), Y(smooth[i - 1])], [X(i + 1), Y(smooth[i])], COLOURS.you, 3, []);
    }
    labels.push([Y(smooth[smooth.length - 1]), COLOURS.you, `you${window_ > 1 ? `, last ${window_}` : ""} ${smooth[smooth.length - 1].toFixed(2)}`]);
    labels.sort((a, b) => a[0] - b[0]);
    let lowest = 0;
    pen.textAlign = "left";
    for (const [y, colour, text] of labels) {
      lowest = Math.max(y, lowest + 15);
      pen.fillStyle = colour;
      pen.fillText(text, width - right + 8, lowest + 4, right - 10);
    }
  }

  // ---- the start ----

  // The resolution of the clock that this browser gives a page, s.
  function clockStep() {
    let step = Infinity;
    const begun = performance.now();
    let last = begun;
    while (last - begun < 15 && performance.now() >= begun) {
      const now = performance.now();
      if (now > last) step = Math.min(step, now - last);
      last = now;
    }
    return Number.isFinite(step) ? Math.min(Math.max(step, 0) / 1000, 1) : 0;
  }

  const bytes = crypto.getRandomValues(new Uint8Array(8));
  game.player = Array.from(bytes, (byte) => byte.toString(16).padStart(2, "0")).join("");
  game.resolution = clockStep();
  $("#consent-text").textContent = "Record my episodes: the times and keys of my presses, the layout, the boat and the " +
    "outcome. They carry a random number, which changes each time the page is loaded. " +
    (data.has_server ? "They are stored in a file on the computer that serves this page." :
      "They stay in this page until you download them as a file.") + " If you do not agree, nothing is recorded.";
  window.addEventListener("resize", () => {
    if (game.screen === "end") drawCurve(game.results[game.mode]);
    else if (game.screen !== "start") draw(game.screen === "result" ? game.results[game.mode].at(-1) : undefined);
  });
  show("start");
})();
