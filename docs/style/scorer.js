/* What a user means first: the page about the word, then the Python name, before long pages in which
   the word occurs often. */
const TOPICS = {
  delay: "why_is_my_delay_wrong", export: "exports", calibrate: "tutorial", csv: "formats",
  backlash: "robot", "dead time": "theory/lag", friction: "theory/servo_models",
  "walking policy": "training",
};
var Scorer = {
  score: (result) => {
    const [page, title, anchor, description, score] = result;
    const query = (new URLSearchParams(window.location.search).get("q") || "").trim().toLowerCase();
    const named = (text) => text.toLowerCase().replaceAll("-", "_").includes(query);
    if (TOPICS[query] === page && !anchor) return score + 60;
    if (title.toLowerCase() === `pupper_sysid.${query}`) return score + 30;
    if (["benchmarks", "contributing", "commands"].includes(page)) return score - 12;
    return named(page.split("/").pop()) ? score + 12 : score;
  },
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
