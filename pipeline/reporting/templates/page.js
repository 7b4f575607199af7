// Sliders and sorting. The page is complete without this script.
"use strict";
for (const input of document.querySelectorAll("[data-toggle]"))
  input.addEventListener("change", () =>
    document.getElementById(input.dataset.target)
      .classList.toggle(input.dataset.toggle, input.value === "on"));

for (const input of document.querySelectorAll(".triple input"))
  input.addEventListener("input", () =>
    input.parentElement.style.setProperty("--at", input.value + "%"));

for (const button of document.querySelectorAll("th button"))
  button.addEventListener("click", () => {
    const head = button.parentElement, table = head.closest("table");
    const column = [...head.parentElement.children].indexOf(head);
    const down = head.getAttribute("aria-sort") === "ascending";
    for (const other of head.parentElement.children) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", down ? "descending" : "ascending");
    const key = row => row.children[column].dataset.value;
    const rows = [...table.tBodies[0].rows];
    rows.sort((a, b) => {
      const x = key(a), y = key(b);
      if (x === "" || y === "") return (x === "") - (y === "");  // missing values last
      const order = isNaN(x) || isNaN(y) ? x.localeCompare(y, "en", {numeric: true}) : x - y;
      return down ? -order : order;
    });
    table.tBodies[0].append(...rows);
  });
