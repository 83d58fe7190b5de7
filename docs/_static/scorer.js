// Ranking of search results: pages whose title has the words come first, objects of the API last.
// eslint-disable-next-line no-unused-vars
var Scorer = {
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,

  // added by where a page is
  folders: { how_to: 20, tutorials: 12, method: 8, developers: -4, reference: -30 },

  score: ([docname, title, anchor, descr, score, filename, kind]) => {
    const query = new URLSearchParams(window.location.search).get("q") || "";
    const words = query.toLowerCase().match(/\w+/g) || [];
    const page = title.toLowerCase();
    const found = words.filter((word) => page.includes(word)).length;
    const folder = docname.includes("/") ? docname.split("/")[0] : "start";
    let rank = Math.min(score, 30) + (Scorer.folders[folder] || 0);
    if (words.length) rank += (30 * found) / words.length;
    if (kind === "object" || kind === "index") rank -= 40;
    if (docname === "changes") rank -= 30;
    if (docname.endsWith("sg_execution_times")) rank -= 60;
    return rank;
  },
};
