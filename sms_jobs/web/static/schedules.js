// The time of a new schedule is written in the form that was chosen.
const form = document.getElementById("form"), when = document.getElementById("when");
form?.addEventListener("change", () => {
  when.name = form.value;
  when.placeholder = form.selectedOptions[0].dataset.example;
});
