// Starts what is on the page: maps when they come into sight, the choice of what charts are drawn along.

const SIDE_BY_SIDE = 12; // of more states one is shown at a time

function chooseAxes(charting) {
  const names = charting.dataset.axes.split("\n");
  if (names.length < 2) return;
  const select = made("select", { class: "axis-choice", onchange: () => {
    for (const chart of charting.querySelectorAll(".chart"))
      chart.classList.toggle("other", chart.dataset.axis !== select.value);
  } }, ...names.map((name, place) => made("option", { value: place }, name)));
  charting.prepend(made("div", { class: "controls" }, made("label", {}, "charts over ", select)));
}

// Many states share one place on the page: what is chosen there is drawn, and nothing is kept of the others.
class Steps {
  constructor(states, near) {
    this.states = states; this.near = near;
    this.views = states.map((state) => views.filter((view) => state.contains(view.section)));
    const last = states.length - 1, names = states.map((state) => state.querySelector("h3").textContent);
    const button = (words, title, by) => made("button", { type: "button", title, "aria-label": title,
      onclick: () => this.show(Math.min(Math.max(this.chosen + by, 0), last)) }, words);
    this.select = made("select", { class: "state-choice", onchange: () => this.show(Number(this.select.value)) },
      ...names.map((name, place) => made("option", { value: place }, name)));
    this.slider = made("input", { type: "range", min: 0, max: last, "aria-label": "state",
      oninput: () => this.show(Number(this.slider.value)) });
    states[0].before(made("div", { class: "controls steps" }, made("label", {}, "state ", this.select),
      button("‹", "state before", -1), this.slider, button("›", "state after", 1)));
    document.documentElement.classList.add("stepping");
    addEventListener("hashchange", () => this.follow());
    this.show(last);
    this.follow();
  }

  // A link leads to a state.
  follow() {
    const place = this.states.findIndex((state) => `#${state.id}` === location.hash);
    if (place < 0) return;
    this.show(place);
    this.states[place].parentElement.querySelector(".steps").scrollIntoView();
  }

  show(place) {
    if (place === this.chosen) return;
    const before = this.views[this.chosen] || [];
    this.states[this.chosen]?.classList.remove("chosen");
    this.states[place].classList.add("chosen");
    this.chosen = place;
    this.select.value = String(place); this.slider.value = String(place);
    for (const [k, view] of this.views[place].entries()) {
      const other = before[k];
      if (other && other.about.key === view.about.key && view.imitate(other))
        Object.assign(view, { zoom: other.zoom, centre: other.centre, cursor: other.cursor });
      this.near.observe(view.section);
    }
    for (const view of before) { this.near.unobserve(view.section); view.rest(); }
  }
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
  const states = [...document.querySelectorAll(".state")], many = states.length > SIDE_BY_SIDE;
  for (const section of sections) {
    const later = many && section.closest(".state") !== null;
    views.push(new View(section, EMBEDDED, later));
    if (!later) near.observe(section);
  }
  if (many) new Steps(states, near);
}

start();
