"use strict";
// The game that the pages of boats have in common: screens, keys and touches, the picture, the table and the curve. Key
// times come from the browser's events (`event.timeStamp`), not from the pictures. Every picture is computed again from
// all events so far. So an event that the browser reports late still counts from the time when it happened.
//
// What people play on a page is its task, an object that `makeTask(game, tools)` returns:
//   noun              what one line of the file is called
//   showsDirections   whether boats and keys have arrows
//   begin(mode)       called when a mode is chosen on the first screen
//   status()          the text in the page's head
//   next()            prepares the next episode: { layout, text, onlyBoat }; with an `onlyBoat` nothing is chosen
//   boat(name)        what a boat does: `directions`, and if it is unlike people's, `strength` and `glide`
//   sailText(name)    the text beside an episode that begins with this boat
//   add(result)       completes the result of an episode with what is to be stored
//   record(result)    what is to be stored after this episode, or null
//   compare(result)   completes the result with what others score on the same layout
//   describe(result)  the text after an episode, and tracks(result) what is drawn of it: { points, colour, dashes }
//   isPause()         whether the screen with the curve comes next, and isDone() whether nothing comes after it
//   endText(), table(results), curve(results): what that screen shows
//   leave()           called if an episode is left before it ends

// The page's `main` gets these sections beside its own first screen and its buttons `#boats`.
const STAGE = `
  <section id="game" hidden>
    <div id="stage">
      <canvas id="harbour" width="480" height="480" aria-label="The harbour from above"></canvas>
      <div id="gauges">
        <div class="gauge"><span>fuel</span><div class="bar" id="fuel"><i></i></div><b id="fuel-text"></b></div>
        <div class="gauge"><span>speed</span><div class="bar" id="speed"><i></i><em></em></div><b id="speed-text"></b></div>
      </div>
      <div id="keys" class="row">
        <button class="key" data-key="0"></button>
        <button class="key" data-key="1"></button>
        <button class="key" data-key="2"></button>
      </div>
    </div>
    <aside>
      <div id="result" aria-live="polite"></div>
      <button id="next" class="main">Next <kbd>Enter</kbd></button>
      <table id="table"></table>
    </aside>
  </section>

  <section id="end" hidden>
    <h2>Your curve</h2>
    <p id="end-text"></p>
    <canvas id="curve" width="720" height="360" aria-label="Your scores"></canvas>
    <table id="end-table"></table>
    <div class="row">
      <button id="go-on" class="main">Go on</button>
      <button id="download"></button>
      <button id="again">Back to the start</button>
    </div>
  </section>`;

function playGame(makeTask) {
  const data = window.HPAMDP_DATA;
  const { rules } = data;
  const physics = makePhysics(rules);
  document.querySelector("main").insertAdjacentHTML("beforeend", STAGE);
  document.querySelector("#gauges").after(document.querySelector("#boats"));

  const LATE = 0.12; // s for which the end of an episode waits for earlier events that are reported late
  const LONGEST = 3600; // s
  const KEYS = {
    Digit1: 0, Numpad1: 0, KeyJ: 0, ArrowLeft: 0,
    Digit2: 1, Numpad2: 1, KeyK: 1, ArrowUp: 1, ArrowDown: 1,
    Digit3: 2, Numpad3: 2, KeyL: 2, ArrowRight: 2,
  };
  const AGENTS = ["#D55E00", "#AA4499", "#0072B2", "#8c6d1f", "#6a3fb5", "#b00020", "#00979c", "#7d7d7d"];
  const COLOURS = { you: "#1d3f58", glide: "#86aecb", plan: "#3c8a55", agents: AGENTS };

  const $ = (selector) => document.querySelector(selector);
  const harbour = $("#harbour");
  const game = {
    screen: "loading", mode: null, layout: null, boat: null, origin: 0, events: [], state: null,
    results: {}, stored: [], unsent: [], sent: 0, refused: [], downloaded: 0, player: null, resolution: 0,
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
    $("#status").textContent = screen === "start" ? "" : task.status();
  }

  function begin(mode) {
    game.mode = mode;
    task.begin(mode);
    choose();
  }

  const shownResults = () => game.results[game.mode];

  function choose() {
    const { layout, text, onlyBoat } = task.next();
    Object.assign(game, { layout, boat: null, state: null });
    show("choose");
    $("#result").innerHTML = `<p>${text}</p>`;
    if (task.showsDirections) {
      for (const card of document.querySelectorAll(".boat")) {
        card.querySelector("svg").replaceChildren(...compass(task.boat(card.dataset.boat).directions));
      }
    }
    $("#table").innerHTML = task.table(shownResults());
    setGauges(rules.tank, 0);
    draw();
    if (onlyBoat !== undefined) sail(onlyBoat, performance.now());
  }

  function sail(boat, time) {
    game.boat = boat;
    game.origin = time;
    game.events = [];
    show("sail");
    const { directions } = task.boat(boat);
    document.querySelectorAll(".key").forEach((button, key) => {
      button.replaceChildren(document.createTextNode(String(key + 1)));
      if (task.showsDirections) button.append(picture([arrow(directions[key], -32, 32)]));
      button.setAttribute("aria-label", `key ${key + 1}`);
    });
    $("#result").innerHTML = `<p>${task.sailText(boat)}</p>`;
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

  // The check of episodes allows at most an hour. A longer episode starts again.
  function leaveOpen() {
    task.leave();
    choose();
    $("#result").insertAdjacentHTML("afterbegin", `<p>The ${task.noun} was open for more than an hour and does not count.</p>`);
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
    } else if (game.screen === "choose" && !event.repeat && cardOf(event.code)) {
      sail(cardOf(event.code).dataset.boat, event.timeStamp);
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

  const cardOf = (code) => Array.from(document.querySelectorAll(".boat")).find((card) => card.dataset.code === code);
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
  $("#finish").addEventListener("click", () => {
    if (game.screen === "sail") task.leave();
    end(true);
  });
  $("#again").addEventListener("click", () => show("start"));
  $("#go-on").addEventListener("click", choose);
  $("#download").addEventListener("click", download);

  // ---- an episode ----

  function frame(now) {
    if (game.screen !== "sail") return;
    const last = game.events.length ? game.events[game.events.length - 1].t : 0;
    const time = Math.max((now - game.origin) / 1000, last, 0);
    game.state = physics.sail(game.layout, task.boat(game.boat), physics.settle(game.events), time);
    setGauges(game.state.fuel, game.state.speed);
    draw();
    if (game.state.outcome !== "sailing" && time > game.state.ended + LATE) finish();
    else requestAnimationFrame(frame);
  }

  function finish() {
    const { state } = game;
    const result = {
      boat: game.boat, outcome: state.outcome, fuel: state.fuel / rules.tank, score: physics.score(state.outcome, state.fuel),
    };
    task.add(result);
    record(result); // first, so that no mistake in what follows loses the episode
    task.compare(result);
    shownResults().push(result);
    document.querySelectorAll(".key.down").forEach((button) => button.classList.remove("down"));
    show("result");
    $("#result").innerHTML = outcomeText(result) + task.describe(result);
    $("#table").innerHTML = task.table(shownResults());
    draw(result);
    $("#next").focus({ preventScroll: true });
  }

  function next() {
    if (game.screen !== "result") return;
    if (task.isPause()) end(false);
    else choose();
  }

  function end(isStopped) {
    const results = shownResults();
    if (!results.length) return show("start");
    show("end");
    $("#go-on").hidden = task.isDone();
    $("#download").disabled = game.stored.length === 0;
    $("#download").title = game.stored.length ? "" : "Nothing is recorded yet, or you did not agree at the start";
    $("#end-text").textContent = task.endText(isStopped);
    drawCurve(task.curve(results));
    $("#end-table").innerHTML = task.table(results);
  }

  // ---- what is kept ----

  function record(result) {
    if (!hasAgreed()) return;
    const own = task.record(result);
    if (own === null) return;
    const episode = {
      format: data.format, software: data.software, consent: true, player: game.player, index: game.stored.length,
      resolution: game.resolution, ...own,
    };
    game.stored.push(episode);
    if (data.has_server) {
      game.unsent.push(episode);
      send();
    }
  }

  // What a line says of the episode that has just ended.
  function sailed(result) {
    const { state, layout, events } = game;
    return {
      start: layout.start, goal: layout.goal, events: events.map((event) => ({ ...event })), presses: state.presses,
      outcome: state.outcome, fuel: result.fuel, score: result.score, end: [state.x, state.y],
    };
  }

  let isSending = false;
  let whyUnsent = ""; // why episodes wait
  async function send() {
    if (isSending) return;
    isSending = true;
    try {
      while (game.unsent.length) {
        const body = JSON.stringify(game.unsent[0]);
        const answer = await fetch("episodes", { method: "POST", headers: { "Content-Type": "application/json" }, body });
        if (answer.status >= 500) throw new Error((await answer.text()).trim() || `the server answered ${answer.status}`);
        if (answer.ok) game.sent += 1;
        else game.refused.push({ index: game.unsent[0].index, why: (await answer.text()).trim() });
        game.unsent.shift();
      }
      whyUnsent = "";
    } catch (error) {
      whyUnsent = error.message;
      setTimeout(send, 3000);
    } finally {
      isSending = false;
    }
    showNotice();
  }

  // Refused episodes that are in no file.
  const lost = () => game.refused.filter(({ index }) => index >= game.downloaded);

  function showNotice() {
    const count = (num, one, more) => `${num} ${task.noun}${num === 1 ? ` ${one}` : `s ${more}`}`;
    const parts = [];
    const refused = lost();
    if (refused.length) {
      const keep = `Finish, and download the ${task.noun}s to keep ${refused.length === 1 ? "it" : "them"}.`;
      parts.push(`${count(refused.length, "was", "were")} refused (${refused.at(-1).why}). ${keep}`);
    }
    if (whyUnsent) {
      parts.push(`${count(game.unsent.length, "waits", "wait")} for the server (${whyUnsent}). You can go on playing.`);
    }
    $("#notice").textContent = parts.join(" ");
  }

  function download() {
    const text = game.stored.map((episode) => `${JSON.stringify(episode)}\n`).join("");
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([text], { type: "application/x-ndjson" }));
    link.download = `episodes-${game.player}.jsonl`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000); // some browsers start reading only later
    game.downloaded = game.stored.length;
    showNotice();
  }

  // Ask before the page closes if it holds the only copy of an episode.
  window.addEventListener("beforeunload", (event) => {
    const isUnsaved = data.has_server ? game.unsent.length || lost().length : game.downloaded < game.stored.length;
    if (isUnsaved) event.preventDefault();
  });

  // ---- what is shown ----

  const mean = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;
  const share = (results) => mean(results.map((r) => (r.outcome === "success" ? 1 : 0)));
  const cssPercent = (value) => `${100 * value}%`;
  const withMinus = (value, digits = 2) => value.toFixed(digits).replace("-", "\u2212");
  const percent = (value) => `${(100 * value).toFixed(0)} %`;
  const colourOf = (i) => COLOURS.agents[i];
  const swatch = (colour, dashes) => `<span class="swatch" style="border-color:${colour};border-top-style:${dashes}"></span>`;
  const escape = (text) => text.replace(/[&<>"]/g, (c) => ({ "&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;" }[c]));

  function outcomeText(result) {
    const why = result.outcome === "too_fast"
      ? ` at ${game.state.speed.toFixed(0)} px/s; the limit is ${rules.docking_speed.toFixed(0)}` : "";
    return `<h3 class="${result.outcome === "success" ? "good" : "bad"}">${rules.outcomes[result.outcome]}${why}</h3>`;
  }

  // A table from its caption, its head and its rows, whose first cell is a class.
  const tableOf = (caption, head, rows) => `<caption>${caption}</caption>` +
    `<tr>${head.map((cell) => `<th>${cell}</th>`).join("")}</tr>` +
    rows.map(([kind, ...cells]) => `<tr class="${kind}">${cells.map((c) => `<td>${c}</td>`).join("")}</tr>`).join("");

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

  function picture(parts) {
    const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
    svg.setAttribute("viewBox", "-50 -50 100 100");
    svg.append(...parts);
    return svg;
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
    if (result) task.tracks(result).forEach(({ points, colour, dashes }) => track(pen, points, colour, dashes));
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

  // `dots` and the `values` of `curves` are pairs of a number (from 1 to `total`) and a score; `levels` are scores.
  function drawCurve({ axis, total, dots, curves, levels }) {
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
    const X = (n) => left + ((n - 1) / (Math.max(total, 2) - 1)) * (width - left - right);
    const Y = (score) => top + ((5 - score) / 6) * (height - top - bottom);
    pen.textAlign = "right";
    for (let score = -1; score <= 5; score++) {
      line(pen, [left, Y(score)], [width - right, Y(score)], "#e8e4d8", 1, []);
      pen.fillStyle = "#7d8b92";
      pen.fillText(withMinus(score, 0), left - 8, Y(score) + 4);
    }
    pen.textAlign = "left";
    pen.fillText(axis, left, height - 10);
    pen.textAlign = "right";
    pen.fillText(String(total), width - right, height - 10);
    const labels = [];
    for (const { value, colour, text, dashes } of levels) {
      line(pen, [left, Y(value)], [width - right, Y(value)], colour, 1.3, dashes);
      labels.push([Y(value), colour, `${text} ${withMinus(value)}`]);
    }
    for (const [n, score] of dots) disc(pen, [X(n), Y(score)], 2.5, "#9fb3c0");
    for (const { values, colour, text, thickness } of curves) {
      values.slice(1).forEach(([n, score], i) =>
        line(pen, [X(values[i][0]), Y(values[i][1])], [X(n), Y(score)], colour, thickness, []));
      const [, last] = values[values.length - 1];
      labels.push([Y(last), colour, `${text} ${withMinus(last)}`]);
    }
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
  const hasAgreed = () => $("#consent").checked;
  const task = makeTask(game, { data, physics, sailed, hasAgreed, mean, share, withMinus, percent, escape, swatch, colourOf,
    tableOf, picture, compass, COLOURS });
  $("#consent-text").textContent = `Record my ${task.noun}s: the times and keys of my presses, the layout, the boat and the ` +
    "outcome. They carry a random number, which changes each time the page is loaded. " +
    (data.has_server ? "They are stored in a file on the computer that serves this page." :
      "They stay in this page until you download them as a file.") + " If you do not agree, nothing is recorded.";
  $("#download").textContent = `Download the ${task.noun}s`;
  window.addEventListener("resize", () => {
    if (game.screen === "end") drawCurve(task.curve(shownResults()));
    else if (game.screen !== "start") draw(game.screen === "result" ? shownResults().at(-1) : undefined);
  });
  show("start");
}
