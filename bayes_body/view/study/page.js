"use strict";
(() => {
  const body = document.querySelector("tbody"), rows = Array.from(body.rows), field = document.querySelector("input");
  const heads = Array.from(document.querySelectorAll("thead th")), chips = Array.from(document.querySelectorAll("button[data-state]"));
  const order = new Intl.Collator(undefined, { numeric: true, sensitivity: "base" });
  let texts = null;

  function valueOf(row, column) {
    const cell = row.cells[column], number = cell.dataset.v;
    if (number !== undefined) return number === "" ? null : Number(number);
    // Links beside a name do not count.
    return (cell.querySelector("b") || cell).textContent.trim() || null;
  }

  function sort(column, direction) {
    const keyed = rows.map((row, place) => [valueOf(row, column), place, row]);
    keyed.sort((a, b) => {
      // What is missing is last in both directions; equal values stay in the order of the study.
      if (a[0] === null || b[0] === null) return (a[0] === null) - (b[0] === null) || a[1] - b[1];
      const difference = typeof a[0] === "number" ? a[0] - b[0] : order.compare(a[0], b[0]);
      return direction * difference || a[1] - b[1];
    });
    body.append(...keyed.map((entry) => entry[2]));
    heads.forEach((head, place) => {
      if (place === column) head.setAttribute("aria-sort", direction > 0 ? "ascending" : "descending");
      else head.removeAttribute("aria-sort");
    });
  }

  function filter() {
    texts = texts || rows.map((row) => row.textContent.toLowerCase());
    const words = field.value.toLowerCase().split(/\s+/).filter(Boolean);
    const states = chips.filter((chip) => chip.getAttribute("aria-pressed") === "true").map((chip) => chip.dataset.state);
    let shown = 0;
    rows.forEach((row, place) => {
      const fits = words.every((word) => texts[place].includes(word)) && (!states.length || states.includes(row.dataset.state));
      row.hidden = !fits;
      shown += fits;
    });
    document.getElementById("shown").textContent = words.length || states.length ? shown + " of " + rows.length + " rows" : "";
  }

  heads.forEach((head, column) => {
    const button = head.querySelector("button");
    if (button) button.addEventListener("click", () => sort(column, head.getAttribute("aria-sort") === "ascending" ? -1 : 1));
  });
  chips.forEach((chip) => chip.addEventListener("click", () => {
    chip.setAttribute("aria-pressed", chip.getAttribute("aria-pressed") !== "true");
    filter();
  }));
  field.addEventListener("input", filter);
  // A browser that comes back to the page keeps what was typed.
  if (field.value) filter();
})();
