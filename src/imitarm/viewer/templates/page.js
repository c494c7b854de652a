"use strict";
// Tabs and their 3-D players: a player is made when it scrolls into view, and removed with its tab.
(() => {
  const tabs = [...document.querySelectorAll('[role="tab"]')];
  const panels = tabs.map((tab) => document.getElementById(tab.getAttribute("aria-controls")));
  const shared = document.getElementById("player-shared");
  const [head, tail] = shared ? JSON.parse(shared.textContent) : ["", ""];

  function load(player) {
    if (player.querySelector("iframe")) return;
    const frame = document.createElement("iframe");
    frame.title = player.dataset.title;
    frame.allow = "fullscreen";
    frame.srcdoc = head + JSON.parse(player.querySelector("script").textContent) + tail;
    player.append(frame);
  }

  function unload(player) {
    const frame = player.querySelector("iframe");
    if (frame) frame.remove(); // a browser gives only a few 3-D contexts
  }

  const seen = new IntersectionObserver((entries) => {
    for (const entry of entries) if (entry.isIntersecting) load(entry.target);
  }, { rootMargin: "200px" });

  function show(index, focus) {
    tabs.forEach((tab, i) => {
      const chosen = i === index;
      tab.setAttribute("aria-selected", String(chosen));
      tab.tabIndex = chosen ? 0 : -1;
      panels[i].hidden = !chosen;
      for (const player of panels[i].querySelectorAll(".player")) {
        if (chosen) seen.observe(player);
        else { seen.unobserve(player); unload(player); }
      }
    });
    if (focus) tabs[index].focus();
  }

  tabs.forEach((tab, i) => {
    tab.addEventListener("click", () => show(i));
    tab.addEventListener("keydown", (event) => {
      const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
      if (step) { show((i + step + tabs.length) % tabs.length, true); event.preventDefault(); }
    });
  });
  for (const button of document.querySelectorAll(".player button")) {
    button.addEventListener("click", () => load(button.parentElement));
  }

  function follow() {
    const index = panels.findIndex((panel) => "#" + panel.id === decodeURIComponent(location.hash));
    if (index >= 0) { show(index); document.getElementById("scenes").scrollIntoView(); }
    return index >= 0;
  }
  addEventListener("hashchange", follow);
  if (tabs.length && !follow()) show(tabs.findIndex((tab) => tab.getAttribute("aria-selected") === "true"));
})();
