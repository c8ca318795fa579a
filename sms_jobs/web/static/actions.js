// Forms with data-action ask the interface for a change: what was typed stays, and a refusal stands beside it.
import { ask } from "./asking.js";

/** Return what a form says, as JSON holds it; a field's data-type says what its text is. */
export function bodyOf(form, submitter) {
  const body = {};
  const place = (name, value) => {
    const [first, ...rest] = name.split(":");
    if (!rest.length) body[first] = value;
    else (body[first] ??= {})[rest.join(":")] = value;
  };
  for (const field of form.elements) {
    if (!field.name || field.disabled || field.type === "submit" || field.type === "button") continue;
    const type = field.dataset.type ?? "text", text = field.value;
    if (field.type === "checkbox" && type === "boolean") place(field.name, field.checked);
    else if (field.type === "checkbox") { if (field.checked) (body[field.name] ??= []).push(field.value); else body[field.name] ??= []; }
    else if (field.type === "radio") { if (field.checked) place(field.name, text); }
    else if (type === "list") place(field.name, text.split(/[\s,]+/).filter(Boolean));
    else if (type === "lines") place(field.name, text.split("\n").map((one) => one.trim()).filter(Boolean));
    else if (text === "" && "optional" in field.dataset) continue;
    else if (type === "number") place(field.name, text === "" ? null : Number(text));
    else if (type === "values") place(field.name, text.split(",").map((one) => valueOf(one.trim())).filter((one) => one !== ""));
    // As on the command line: text, or texts with commas between them.
    else if (type === "parameter") place(field.name, text.includes(",") ? text.split(",").map((one) => one.trim()).filter(Boolean) : text.trim());
    else if (type === "value") place(field.name, valueOf(text));
    else if (type === "when") place(field.name, new Date(text).toISOString());
    else place(field.name, text);
  }
  if (submitter?.dataset.set) Object.assign(body, JSON.parse(submitter.dataset.set));
  return body;
}

function valueOf(text) {
  try { return JSON.parse(text); } catch { return text; }
}

function confirmed(words) {
  const dialog = document.getElementById("confirm");
  document.getElementById("confirm-words").textContent = words;
  dialog.returnValue = "no";
  dialog.showModal();
  return new Promise((done) => dialog.addEventListener("close", () => done(dialog.returnValue === "yes"), { once: true }));
}

function beside(form, name, role) {
  let place = form.querySelector(`:scope > .${name}`);
  if (!place) {
    place = document.createElement("div");
    place.className = name;
    place.setAttribute("role", role);
    form.append(place);
  }
  return place;
}

async function act(form, submitter) {
  const words = submitter?.dataset.confirm ?? form.dataset.confirm;
  const problem = beside(form, "problem", "alert");
  problem.textContent = document.getElementById("said").textContent = "";
  form.closest("[data-live]")?.querySelectorAll(":scope > .refusal").forEach((one) => one.remove());
  if (words && !(await confirmed(words))) { changed(); return; }
  const buttons = [...form.querySelectorAll("button")];
  for (const one of buttons) one.disabled = true;
  try {
    const told = await ask(form.dataset.method ?? "POST", submitter?.dataset.action ?? form.dataset.action,
      form.dataset.body === "none" ? undefined : bodyOf(form, submitter));
    for (const secret of form.querySelectorAll("input[type=password]")) secret.value = "";
    form.dispatchEvent(new CustomEvent("done", { bubbles: true, detail: { told, submitter } }));
  } catch (error) {
    problem.textContent = `${error.message}.`;
    problem.scrollIntoView({ block: "nearest" });
    changed();
  } finally {
    for (const one of buttons) one.disabled = false;
    // A button that was pressed by a key has lost the focus meanwhile.
    if (document.activeElement === document.body) submitter?.focus({ preventScroll: true });
  }
}

// The page is fetched again: also after a refusal or a question, during which it stays as it is.
const changed = () => document.dispatchEvent(new CustomEvent("changed"));

function after(form, told, submitter) {
  const then = submitter?.dataset.then ?? form.dataset.then ?? "refresh";
  if (then.startsWith("/")) location.assign(then);
  else if (then === "reload") location.reload();
  else if (then !== "nothing") changed();
  const words = form.dataset.said;
  if (words) document.getElementById("said").textContent = words;
}

function isFilledIn(field) {
  if (field.options) return field.selectedIndex !== Math.max(0, [...field.options].findIndex((one) => one.defaultSelected));
  return field.type === "checkbox" ? field.checked !== field.defaultChecked : field.value !== field.defaultValue;
}

/** Let the forms of a document ask for what they say. */
export function listen(document) {
  document.addEventListener("submit", (event) => {
    const form = event.target;
    if (!form.dataset.action) return;
    event.preventDefault();
    act(form, event.submitter);
  });
  document.addEventListener("done", (event) => after(event.target, event.detail.told, event.detail.submitter));
  // What the browser has kept of a form while another page was shown is not folded away: it would be sent unseen.
  addEventListener("pageshow", () => {
    for (const field of document.querySelectorAll("form[data-action] details :is(input, select, textarea)")) if (isFilledIn(field)) field.closest("details").open = true;
  });
}
