// A secret that was made is shown this once.
document.addEventListener("done", (event) => {
  const { told } = event.detail, place = event.target.querySelector(".outcome");
  if (told.secret && place) place.textContent = `${told.secret}\nCopy it now: it is not shown again.`;
});
