// The policy of the page lets no text become markup. Leaflet asks once, when it is loaded, whether the browser knows
// SVG, by the markup of an empty one: that alone passes.
"use strict";
if (globalThis.trustedTypes) {
  trustedTypes.createPolicy("default", {
    createHTML(text) {
      if (text === "<svg/>") return text;
      throw new TypeError("no text becomes markup here");
    },
  });
}
