// The form that submits work: another kind brings its own parameters, an estimate is shown before anything is done.
const choose = document.getElementById("choose"), form = document.getElementById("submit");
choose?.querySelector("select").addEventListener("change", () => choose.requestSubmit());
// A browser that goes back keeps what was chosen; what would be submitted is the kind of this page.
addEventListener("pageshow", () => choose?.reset());

const time = (seconds) => seconds < 120 ? `${Math.round(seconds)} s` : seconds < 7200 ? `${Math.round(seconds / 60)} min` : `${(seconds / 3600).toFixed(1)} h`;

form?.addEventListener("submit", () => { form.querySelector(".outcome").textContent = ""; });
form?.addEventListener("done", (event) => {
  const { told, submitter } = event.detail, dry = submitter?.id === "estimate";
  const counted = Object.entries(told.counted).map(([kind, count]) => `${count} ${kind}`).join(", ");
  const ahead = told.estimate, lines = [];
  if (!told.jobs.length) lines.push("Nothing is missing: there is nothing to compute.");
  else {
    lines.push(`${dry ? "Would submit" : "Submitted"} ${told.jobs.length} job${told.jobs.length === 1 ? "" : "s"}: ${counted}${ahead.reused ? `; ${ahead.reused} of them reused` : ""}.`);
    lines.push(ahead.seconds === null ? "How long they take is not known."
      : `They take about ${time(ahead.seconds)}${ahead.alive ? "" : " once the service is started"}.`);
    const unknown = Object.keys(ahead.unknown);
    if (unknown.length) lines.push(`Longer, as ${unknown.join(", ")} never ran here.`);
    if (ahead.paused.length) lines.push(`Paused: ${ahead.paused.join(", ")}.`);
  }
  for (const one of told.refused) lines.push(`Left out is ${one.subject}: ${one.why}.`);
  form.querySelector(".outcome").textContent = lines.join(" ");
});
