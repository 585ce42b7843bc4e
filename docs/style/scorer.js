/* What a user means first: the Python name itself and pages named after the word, before long pages
   in which it occurs often. */
var Scorer = {
  score: (result) => {
    const [page, title, anchor, description, score] = result;
    const query = (new URLSearchParams(window.location.search).get("q") || "").trim().toLowerCase();
    const named = (text) => text.toLowerCase().replaceAll("-", "_").includes(query);
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
