// What every page does: the theme, times in this zone, forms that ask for a change, regions that are live.
import { localTimes } from "./times.js";
import { listen } from "./actions.js";
import { follow } from "./live.js";

const root = document.documentElement;
document.getElementById("theme").addEventListener("click", () => {
  const dark = root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  root.dataset.theme = dark ? "light" : "dark";
  try { localStorage.setItem("theme", root.dataset.theme); } catch { /* it is for this page alone then */ }
});
localTimes(document);
listen(document);
follow(document);
