// Starts what is on the page: maps when they come into sight, the choice of what charts are drawn along.

function chooseAxes(charting) {
  const names = charting.dataset.axes.split("\n");
  if (names.length < 2) return;
  const select = made("select", { class: "axis-choice", onchange: () => {
    for (const chart of charting.querySelectorAll(".chart"))
      chart.classList.toggle("other", chart.dataset.axis !== select.value);
  } }, ...names.map((name, place) => made("option", { value: place }, name)));
  charting.prepend(made("div", { class: "controls" }, made("label", {}, "charts over ", select)));
}

function start() {
  for (const charting of document.querySelectorAll(".charting")) chooseAxes(charting);
  const sections = [...document.querySelectorAll("section.view")];
  // A browser without this is shown the still pictures.
  if (!sections.length || typeof DecompressionStream === "undefined") return;
  document.documentElement.classList.add("scripted");
  const near = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      if (!entry.isIntersecting) continue;
      near.unobserve(entry.target);
      views.find((view) => view.section === entry.target).refresh();
    }
  }, { rootMargin: "400px" });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    for (const view of views) if (view.values) view.refresh();
  });
  for (const section of sections) {
    views.push(new View(section, EMBEDDED));
    near.observe(section);
  }
}

start();
