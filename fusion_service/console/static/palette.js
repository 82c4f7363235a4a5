// Colours of the map, as the theme has them, and the theme itself: as the system, or as it was chosen.

import { byId } from "/static/dom.js";

const NAMES = ["confirmed", "tentative", "coasting", "chosen", "alarm", "text", "faint", "line", "halo", "cover"];
const THEMES = ["auto", "light", "dark"];
const WORDS = { auto: "as the system", light: "light", dark: "dark" };
const KEY = "fusion-console-theme";

export const palette = {};

/** Read the colours that the style sheet has now. */
export function readPalette() {
  const probe = document.createElement("span");
  probe.hidden = true;
  document.body.append(probe);
  for (const name of NAMES) {
    probe.style.color = `var(--${name})`;
    palette[name] = getComputedStyle(probe).color;
  }
  probe.remove();
}

/** Follow the system and the button; changed(): when the colours are others. */
export function followTheme(changed) {
  const button = byId("theme");
  let theme = "auto";
  try {
    theme = THEMES.includes(localStorage.getItem(KEY)) ? localStorage.getItem(KEY) : "auto";
  } catch {
    // a browser that keeps nothing
  }
  const show = () => {
    document.documentElement.dataset.theme = theme;
    button.textContent = { auto: "Auto", light: "Light", dark: "Dark" }[theme];
    button.setAttribute("aria-label", `Theme: ${WORDS[theme]}`);
    readPalette();
    changed();
  };
  button.addEventListener("click", () => {
    theme = THEMES[(THEMES.indexOf(theme) + 1) % THEMES.length];
    try {
      localStorage.setItem(KEY, theme);
    } catch {
      // as above
    }
    show();
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", show);
  show();
}
