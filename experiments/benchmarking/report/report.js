"use strict";
// Selects the page of a report by the fragment of the address, copies images that are shown more
// than once, and moves the slider. Without it the page shows everything, one below the other.
(() => {
  const overview = document.getElementById("overview");
  const scenes = [...document.querySelectorAll("section.scene")];
  const pair = { left: null, right: null };
  let at = 50;

  const decoded = (word) => {
    try { return decodeURIComponent(word); } catch { return word; }
  };

  function route() {
    const [kind, scene, view] = location.hash.slice(1).split("/").map(decoded);
    const page = kind === "scene" ? scenes.find((each) => each.dataset.scene === scene) : undefined;
    const wasHidden = page ? page.hidden : overview.hidden;
    overview.hidden = page !== undefined;
    for (const each of scenes) each.hidden = each !== page;
    document.title = page ? `${scene}, benchmark` : "Benchmark";
    if (page) {
      choose(page, view);
      if (wasHidden) scrollTo(0, 0);
    } else if (wasHidden) {
      const target = kind ? document.getElementById(kind) : null;
      if (target) target.scrollIntoView(); else scrollTo(0, 0);
    }
  }

  // Shows one view of a scene: the requested one, or its first.
  function choose(page, asked) {
    const views = [...page.querySelectorAll("article")];
    const shown = views.find((each) => each.dataset.view === asked) ?? views[0];
    for (const each of views) each.hidden = each !== shown;
    page.querySelectorAll(".views a").forEach((link, i) => {
      if (views[i] === shown) link.setAttribute("aria-current", "true");
      else link.removeAttribute("aria-current");
    });
    if (shown) fill(page, shown);
  }

  // Fills the slider with two images of a view.
  function fill(page, view) {
    const slider = page.querySelector(".slider");
    const pictures = new Map();
    for (const image of view.querySelectorAll("img[data-key]")) {
      pictures.set(image.dataset.key, image);
    }
    let both = true;
    for (const [side, place] of [["left", ".over"], ["right", ".under"]]) {
      const choice = slider.querySelector(`select.${side}`);
      const wanted = [...choice.options].some((option) => option.value === pair[side]);
      if (wanted) choice.value = pair[side];
      const source = pictures.get(choice.value);
      const image = slider.querySelector(place);
      both = both && source !== undefined;
      if (source) {
        image.src = source.src;
        image.width = source.width;
        image.height = source.height;
        image.alt = source.alt;
      } else {
        image.removeAttribute("src");
      }
    }
    for (const part of slider.querySelectorAll(".wipe img, .bar")) part.hidden = !both;
    slider.querySelector(".absent").hidden = both;
    slider.hidden = false;
    move(slider, at);
  }

  function move(slider, share) {
    at = Math.min(100, Math.max(0, share));
    slider.querySelector("input").value = at;
    slider.querySelector(".wipe").style.setProperty("--at", `${at}%`);
  }

  for (const page of scenes) {
    const slider = page.querySelector(".slider");
    if (!slider) continue;
    const wipe = slider.querySelector(".wipe");
    const follow = (event) => {
      const box = wipe.getBoundingClientRect();
      move(slider, (100 * (event.clientX - box.left)) / box.width);
    };
    slider.querySelector("input").addEventListener("input", (event) => {
      move(slider, Number(event.target.value));
    });
    wipe.addEventListener("pointerdown", (event) => {
      wipe.setPointerCapture(event.pointerId);
      follow(event);
    });
    wipe.addEventListener("pointermove", (event) => {
      if (wipe.hasPointerCapture(event.pointerId)) follow(event);
    });
    for (const side of ["left", "right"]) {
      slider.querySelector(`select.${side}`).addEventListener("change", (event) => {
        pair[side] = event.target.value;
        fill(page, page.querySelector("article:not([hidden])"));
      });
    }
  }

  const failing = document.getElementById("failing");
  if (failing) {
    failing.closest("label").hidden = false;
    failing.addEventListener("change", () => {
      for (const row of document.querySelectorAll(".cases li")) {
        row.hidden = failing.value !== "" && row.dataset.method !== failing.value;
      }
    });
  }

  for (const copy of document.querySelectorAll("img[data-copy]")) {
    copy.src = document.getElementById(copy.dataset.copy).src;
  }
  addEventListener("hashchange", route);
  route();
})();
