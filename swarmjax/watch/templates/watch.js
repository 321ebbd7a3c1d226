"use strict";
(() => {
const PAUSE = 2000; // ms between two questions to the server
const page = (id) => document.getElementById(id);
const shown = { figures: 0, replay: 0 }; // versions

/** Writes a text, and hides where it stands if it is empty. */
function say(id, text) {
  if (page(id).textContent !== text) page(id).textContent = text;
  page(id).hidden = !text;
}

/** Loads the figures that are newer than those that are shown. */
function showFigures({ version, names }) {
  if (version === shown.figures) return;
  shown.figures = version;
  for (const figure of document.querySelectorAll("figure")) {
    if (!names.includes(figure.id)) continue;
    const next = new Image(); // shown when it is whole, so that nothing flickers
    next.onload = () => {
      figure.querySelector("img").src = next.src;
      figure.hidden = false;
    };
    next.src = `/figures/${figure.id}.png?${version}`;
  }
}

/** Loads a replay that is newer than the one that is shown, if it is to be followed. */
function showReplay({ version, sentence, trouble }) {
  say("replay-trouble", trouble);
  if (!version && trouble) say("seen", "");
  if (!version || version === shown.replay || (shown.replay && !page("follow").checked)) return;
  shown.replay = version;
  say("seen", sentence);
  page("choices").hidden = page("replay").hidden = false;
  page("replay").src = `/replay.html?${version}`;
}

/** Lists what is known of the run. */
function showFacts(facts) {
  page("facts").replaceChildren(...facts.flatMap(([what, text]) => {
    const [term, description] = ["dt", "dd"].map((tag) => document.createElement(tag));
    term.textContent = what;
    description.textContent = text;
    return [term, description];
  }));
}

/** Asks what there is to show, and shows it. */
async function look() {
  try {
    const found = await (await fetch("/state.json")).json();
    page("status").className = found.state;
    say("status", found.sentence);
    say("trouble", found.trouble);
    showFigures(found.figures);
    showFacts(found.facts);
    showReplay(found.replay);
  } catch {
    say("trouble", "The command that serves this page has ended: what is shown is the last it knew.");
  }
  setTimeout(look, PAUSE);
}

look();
})();
