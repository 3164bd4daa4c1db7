"use strict";
// A page of boats in node: stand-ins for the browser's document, clock and network, and somebody who plays.
// `openPage(data, files)` runs the page's scripts and returns that player. Elements are found by their selector alone.

const fs = require("fs");
const vm = require("vm");

function openPage(data, files, { boats = [] } = {}) {
  const elements = {};
  const listeners = {};
  const frames = [];
  const answers = []; // of the server, one a request; an Error: the server is gone
  const sent = [];
  let timers = [];
  let clock = 0; // ms
  const pen = new Proxy({}, { get: () => () => {}, set: () => true });

  function element(selector, dataset = {}) {
    const own = {};
    return {
      selector, dataset, style: {}, hidden: false, checked: false, textContent: "", innerHTML: "", value: "1",
      classList: { add: () => {}, remove: () => {} },
      addEventListener: (type, call) => { own[type] = call; },
      click: (event) => own.click && own.click({ timeStamp: 0, ...event }),
      querySelector: (inner) => find(`${selector} ${inner}`),
      insertAdjacentHTML: () => {}, replaceChildren: () => {}, append: () => {}, after: () => {}, focus: () => {},
      setAttribute: () => {}, getContext: () => pen,
    };
  }
  function find(selector) {
    elements[selector] ||= element(selector);
    return elements[selector];
  }

  const keys = [0, 1, 2].map((key) => element(".key", { key: String(key) }));
  const cards = boats.map((boat) => element(".boat", { boat, code: boat }));
  const modes = ["practice", "round", "free", "session"].map((mode) => element("[data-mode]", { mode }));
  const lists = { ".key": keys, ".boat": cards, "[data-mode]": modes };
  const document = {
    body: { dataset: {} }, addEventListener: () => {},
    querySelector: (selector) => (selector.startsWith(".key[") ? keys[Number(selector.match(/\d/)[0])] : find(selector)),
    querySelectorAll: (selector) => lists[selector] || [],
    createElement: () => element("created"),
    createElementNS: () => element("created"),
    createTextNode: () => element("text"),
  };
  const window = {
    HPAMDP_DATA: data, scrollTo: () => {}, addEventListener: (type, call) => { listeners[type] = call; },
  };
  const fetch = async (address, { body }) => {
    const answer = answers.shift() || { status: 201, text: "stored" };
    if (answer instanceof Error) throw answer;
    sent.push(JSON.parse(body));
    return { status: answer.status, ok: answer.status < 300, text: async () => answer.text };
  };
  const context = vm.createContext({
    window, document, fetch, atob, Blob, console, URL: { createObjectURL: () => "", revokeObjectURL: () => {} },
    crypto: { getRandomValues: (bytes) => bytes }, performance: { now: () => (clock += 1) },
    requestAnimationFrame: (call) => frames.push(call), setTimeout: (call) => timers.push(call),
  });
  for (const file of files) vm.runInContext(fs.readFileSync(file, "utf8"), context, { filename: file });
  const { hpamdpGame: game } = window;

  return {
    game, find, sent, answers,
    text: (selector) => find(selector).textContent || find(selector).innerHTML,
    agree: (does = true) => { find("#consent").checked = does; },
    start: (mode) => modes.find((button) => button.dataset.mode === mode).click(),
    click: (selector) => find(selector).click(),
    // Hold key 2 for so long, without or after the choice of a boat, and wait until the episode is over.
    sail(boat, seconds = 1.8) {
      if (boat !== null) cards.find((card) => card.dataset.boat === boat).click({ timeStamp: clock });
      const event = { code: "KeyK", preventDefault: () => {}, target: { closest: () => null } };
      for (let i = 0; i < 6 && game.screen === "sail"; i++) {
        listeners.keydown({ ...event, timeStamp: clock + 1000 });
        listeners.keyup({ ...event, timeStamp: clock + 1000 * (1 + seconds) });
        clock += 9000;
        frames.splice(0).forEach((call) => call(clock));
      }
    },
    // Let the page handle the server's answers, and then what it does later.
    async settle({ later = false } = {}) {
      for (let i = 0; i < 20; i++) await Promise.resolve();
      await new Promise((done) => setImmediate(done));
      if (!later) return;
      timers.splice(0).forEach((call) => call());
      await this.settle();
    },
    asksBeforeClosing() {
      let asks = false;
      listeners.beforeunload({ preventDefault: () => { asks = true; } });
      return asks;
    },
  };
}

module.exports = { openPage };
