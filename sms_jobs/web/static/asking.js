// Requests to this site's own interface, and what its refusals say.
export const API = "/api/v1";

const TYPED = "form[data-action] :is(textarea, input:not([type=hidden], [type=checkbox], [type=radio], [type=password]))";

/** The log-in page, with the way back to this one; in another window where something has been typed here. */
export function logInAgain() {
  const door = `/login?next=${encodeURIComponent(location.pathname + location.search)}`;
  if (![...document.querySelectorAll(TYPED)].some((one) => one.value !== one.defaultValue)) {
    location.assign(door);
    return;
  }
  const line = document.getElementById("connection"), way = document.createElement("a");
  if (line.querySelector("a")) return;
  Object.assign(way, { href: door, target: "_blank", textContent: "Log in in another window" });
  line.replaceChildren("Your session has ended. ", way, ", then go on here: what is typed stays.");
  line.hidden = false;
}

/** Ask for something; returns the answer as an object, or throws an Error with the sentence of the refusal. */
export async function ask(method, address, body) {
  let answer;
  try {
    answer = await fetch(address, {
      method,
      headers: body === undefined ? {} : { "Content-Type": "application/json" },
      body: body === undefined ? undefined : JSON.stringify(body),
    });
  } catch {
    throw new Error("the server does not answer; nothing is known of what was asked: try again in a moment");
  }
  const text = await answer.text();
  let told = {};
  try { told = text ? JSON.parse(text) : {}; } catch { /* no JSON: the status has to do */ }
  if (answer.status === 401) logInAgain();
  if (!answer.ok) throw new Error(told.error ?? `the server answered ${answer.status}; try again in a moment`);
  return told;
}
