// Before anything is painted: the theme that was chosen in this browser, and that scripts run.
"use strict";
document.documentElement.classList.add("scripted");
try {
  const chosen = localStorage.getItem("theme");
  if (chosen === "light" || chosen === "dark") document.documentElement.dataset.theme = chosen;
} catch { /* without a memory the browser's own theme is taken */ }
