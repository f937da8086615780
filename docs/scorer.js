// How Sphinx ranks what a search finds: its own weights, and the page of messages first, then errors, then which number to read.
// `var`, as the script that uses it declares it again.
var Scorer = {
  score: ([docname, title, anchor, description, score]) =>
    score + ({ "reference/messages": 100, "reference/errors": 75, "which-number": 50 }[docname] ?? 0),
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
