// The time of a new schedule is written in the form that was chosen; another kind brings its own parameters.
const form = document.getElementById("form"), when = document.getElementById("when");
function take() {
  when.name = form.value;
  when.placeholder = form.selectedOptions[0].dataset.example;
}
form?.addEventListener("change", take);

const choose = document.getElementById("choose");
choose?.querySelector("select").addEventListener("change", () => choose.requestSubmit());
// A browser that goes back keeps what was chosen: the form of the time, and a kind that is not that of this page.
addEventListener("pageshow", () => {
  choose?.reset();
  if (form) take();
});

// In the calendar arrow keys go from day to day, Page Up and Page Down from month to month.
const STEPS = { ArrowLeft: -1, ArrowRight: 1, ArrowUp: -7, ArrowDown: 7 };
const MONTHS = { PageUp: "month-before", PageDown: "month-after" };
document.addEventListener("keydown", (event) => {
  const day = event.target.closest?.(".calendar a");
  if (!day || event.altKey || event.ctrlKey || event.metaKey) return;
  const days = [...document.querySelectorAll(".calendar a")];
  const next = days[days.indexOf(day) + STEPS[event.key]] ?? document.getElementById(MONTHS[event.key]);
  if (!next) return;
  event.preventDefault();
  if (event.key in MONTHS) next.click();
  else next.focus();
});
