// Times are sent in UTC and shown in the zone of this browser; the UTC stays in the title.
const shown = new Intl.DateTimeFormat("sv-SE", { dateStyle: "short", timeStyle: "medium" });

/** Write every time below a node in this zone. */
export function localTimes(node) {
  for (const one of node.querySelectorAll("time[datetime]")) {
    const moment = new Date(one.dateTime);
    if (!Number.isNaN(moment.valueOf())) one.textContent = shown.format(moment);
  }
}
