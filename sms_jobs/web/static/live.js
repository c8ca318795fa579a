// Regions with data-live are fetched again when something has happened, and every data-every seconds. What data-hears
// names, such as "recording job", are the only events that concern a region; without it all do.
import { API, logInAgain } from "./asking.js";
import { localTimes } from "./times.js";

const GATHERED_MS = 50, LONGEST_PAUSE_MS = 15000, SILENT_MS = 40000;
// The first event is shown at once. While things happen all the time, a page then rests for as long as the server
// says with each answer (`pacing.py`), and for this long after one that did not say.
const REST_MS = 3000;
const REFUSED = { 403: "You may no longer see this page", 404: "This page is gone" };

/** Keep the live regions of a document as the server has them. */
export function follow(document) {
  const regions = () => [...document.querySelectorAll("[data-live]")];
  if (!regions().length) return;
  let asked = 0, busy = false, again = false, rested = 0;

  async function refresh() {
    if (busy) { again = true; return; }
    busy = true;
    let rest = REST_MS;
    try {
      const answer = await fetch(location.href, { headers: { Accept: "text/html" }, signal: late() });
      rest = Number(answer.headers.get("X-Rest-Ms") ?? REST_MS);
      if (answer.redirected && new URL(answer.url).pathname === "/login") { logInAgain(); return; }
      if (!answer.ok) { away(REFUSED[answer.status] ?? "The server cannot answer now"); return; }
      const fresh = new DOMParser().parseFromString(await answer.text(), "text/html");
      // Somebody else may have logged in, in another window of this browser.
      const [shown, now] = [document, fresh].map((one) => one.querySelector(".who a"));
      if (shown && now && shown.textContent !== now.textContent) shown.replaceChildren(...now.childNodes);
      for (const old of regions()) {
        const made = fresh.getElementById(old.id);
        if (made) replace(old, made);
      }
      back();
    } catch {
      away("The server does not answer");
    } finally {
      busy = false;
      rested = performance.now() + rest;
      if (again) { again = false; soon(); }
    }
  }

  // A server that takes a request and says nothing is away as well.
  function late() {
    const stop = new AbortController();
    setTimeout(() => stop.abort(), SILENT_MS);
    return stop.signal;
  }

  function replace(old, made) {
    localTimes(made);
    if (old.innerHTML === made.innerHTML || inUse(old)) return;
    const focus = old.contains(document.activeElement) ? nameOf(document.activeElement) : "";
    const open = [...old.querySelectorAll("details[open][id]")].map((one) => one.id);
    const typed = [...old.querySelectorAll("input[id], textarea[id]")].filter((one) => one.value !== one.defaultValue);
    const wide = [...old.querySelectorAll(".wide")].map((one) => one.scrollLeft);
    // A log that is read to its end stays at its end.
    const logs = [...old.querySelectorAll("pre.log")].map((one) => (one.scrollTop + one.clientHeight >= one.scrollHeight - 8 ? null : one.scrollTop));
    const refusals = [...old.querySelectorAll("form[data-action] > .problem:not(:empty), :scope > .refusal")].map((one) => [one, one.closest("form")?.querySelector("button[id]")?.id]);
    old.replaceChildren(...made.childNodes);
    // A refusal stays beside its button; where that is gone, it says at the head of the region why nothing was done.
    const left = [];
    for (const [refusal, button] of refusals) {
      const form = document.getElementById(button)?.closest("form");
      if (form) form.append(refusal);
      else { refusal.classList.add("refusal"); left.push(refusal); }
    }
    old.prepend(...left);
    for (const id of open) document.getElementById(id)?.setAttribute("open", "");
    for (const { id, value } of typed) Object.assign(document.getElementById(id) ?? {}, { value });
    old.querySelectorAll(".wide").forEach((one, place) => { one.scrollLeft = wide[place] ?? 0; });
    old.querySelectorAll("pre.log").forEach((one, place) => { one.scrollTop = logs[place] ?? one.scrollHeight; });
    if (focus) old.querySelector(focus)?.focus({ preventScroll: true });
  }

  // By what something that has the focus is found again once it is made anew.
  function nameOf(one) {
    if (one.id) return `#${CSS.escape(one.id)}`;
    if (one.matches("a[href]")) return `a[href="${CSS.escape(one.getAttribute("href"))}"]`;
    if (one.matches("details[id] > summary")) return `#${CSS.escape(one.parentElement.id)} > summary`;
    return one.matches("pre.log") ? "pre.log" : "";
  }

  // What somebody is typing into, or is asked about, stays, and what was typed and refused.
  const inUse = (region) => document.querySelector("dialog[open]") !== null
    || region.matches(":has(input:focus, select:focus, textarea:focus, button:disabled)")
    || [...region.querySelectorAll("form > .problem:not(:empty)")].some((one) => one.parentElement.matches(":has(input:not([type=hidden]), select, textarea)"));

  function soon() {
    // What comes meanwhile is in the same answer; the first of many is not kept waiting by those after it.
    if (asked) return;
    asked = setTimeout(() => { asked = 0; refresh(); }, Math.max(GATHERED_MS, rested - performance.now()));
  }

  const line = document.getElementById("connection");
  function away(words) {
    const told = `${words}; what is shown may be old. Trying again by itself.`;
    if (line.textContent !== told) line.textContent = told;
    line.hidden = false;
  }
  function back() {
    line.hidden = true;
    line.textContent = "";
  }

  document.addEventListener("changed", soon);
  document.addEventListener("visibilitychange", () => { if (!document.hidden) soon(); });
  const every = Math.min(...regions().map((one) => Number(one.dataset.every ?? 30)));
  setInterval(() => { if (!document.hidden) refresh(); }, 1000 * every);
  const about = document.querySelector("[data-about]")?.dataset.about ?? "";
  const hears = (name) => regions().some((one) => !one.dataset.hears || one.dataset.hears.split(" ").includes(name));
  events((event, name) => {
    // What is about no one campaign, such as the calibration of a rig, may concern any.
    if (hears(name) && (!about || !event.campaign || event.job === about || event.campaign === about)) soon();
  }, soon, away);
}

/** Call `heard` with every event and its name; the connection is made again whenever it ends, from where it ended. */
export async function events(heard, connected, away) {
  // From where the server had read for this page, so that nothing that happened meanwhile is missed.
  let last = document.querySelector("[data-heard-until]")?.dataset.heardUntil ?? "", pause = 500;
  for (;;) {
    if (document.hidden) {
      // A browser makes few connections to one place: those of pages that nobody sees are given back.
      await new Promise((done) => document.addEventListener("visibilitychange", done, { once: true }));
      continue;
    }
    const stop = new AbortController(), silent = setTimeout(() => stop.abort(), SILENT_MS);
    try {
      const answer = await fetch(`${API}/events`, {
        headers: { Accept: "text/event-stream", ...(last ? { "Last-Event-ID": last } : {}) }, signal: stop.signal,
      });
      clearTimeout(silent);
      if (answer.status === 401) { logInAgain(); pause = LONGEST_PAUSE_MS; }
      if (!answer.ok) throw new Error(String(answer.status));
      if (pause > 500) connected();
      pause = 500;
      last = await read(answer.body.getReader(), stop, heard, last);
    } catch (error) {
      if (pause > 2000 && !["401", "404"].includes(error.message)) away("The server does not answer");
    }
    await new Promise((done) => setTimeout(done, pause));
    pause = Math.min(2 * pause, LONGEST_PAUSE_MS);
  }
}

async function read(reader, stop, heard, last) {
  const decoder = new TextDecoder();
  document.addEventListener("visibilitychange", () => stop.abort(), { once: true });
  let rest = "", id = last;
  for (;;) {
    const silent = setTimeout(() => stop.abort(), SILENT_MS);
    let part;
    try { part = await reader.read(); } catch { return id; } finally { clearTimeout(silent); }
    if (part.done) return id;
    const blocks = (rest + decoder.decode(part.value, { stream: true })).split(/\r?\n\r?\n/);
    rest = blocks.pop();
    for (const block of blocks) {
      let data = "", name = "";
      for (const line of block.split(/\r?\n/)) {
        if (line.startsWith("id:")) id = line.slice(3).trim();
        else if (line.startsWith("event:")) name = line.slice(6).trim();
        else if (line.startsWith("data:")) data += line.slice(5).trim();
      }
      if (data) heard(JSON.parse(data), name);
    }
  }
}
