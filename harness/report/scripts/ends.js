// How a decision ended, in signs and words.

const ENDS = { s: ["good", "✓"], d: ["slow", "◷"], u: ["bad", "✗"], n: ["", "○"], "-": ["quiet", ""] };
const endWords = (live) => (live
  ? { s: "success", d: "cleared too late", u: "failed", n: "", "-": "not at this decision point" }
  : {
    s: "safe", d: "safe, slower than the best", u: "the answer that lost this episode",
    n: "success was no longer possible", "-": "not decided",
  });

const mark = (end, live) => h("span", { class: ENDS[end][0], title: endWords(live)[end] }, ENDS[end][1]);
