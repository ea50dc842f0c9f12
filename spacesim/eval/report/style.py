"""The report's style sheet: light and dark, wide and narrow, screen and paper."""

STYLE = """
:root {
  --paper: #fcfcfa; --card: #ffffff; --ink: #1b2027; --muted: #5a6472; --line: #e2e3de; --wash: #f3f3ef;
  --s0: #2a66ad; --s1: #b9560f; --s2: #2f7d4f; --s3: #8a4b9e; --s4: #a33a3a; --s5: #5c6b00;
  --serif: "Iowan Old Style", "Palatino Linotype", Palatino, "URW Palladio L", Georgia, serif;
  --sans: system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", "Noto Sans", "DejaVu Sans",
    sans-serif;
}
@media (prefers-color-scheme: dark) {
  :root {
    --paper: #131519; --card: #1a1d22; --ink: #e7e8ea; --muted: #9aa4b1; --line: #2c3138; --wash: #1e2127;
    --s0: #74aef0; --s1: #f0a062; --s2: #74c796; --s3: #cb9ade; --s4: #ec8f8f; --s5: #c2d05c;
  }
}
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; }
body { margin: 0; background: var(--paper); color: var(--ink); font: 16px/1.6 var(--sans); }
main { max-width: 1120px; margin: 0 auto; padding: 4rem 2rem 6rem; }
header { margin-bottom: 3rem; }
h1, h2, h3 { font-family: var(--serif); font-weight: 600; line-height: 1.2; text-wrap: balance; }
h1 { font-size: clamp(1.9rem, 4.5vw, 2.9rem); letter-spacing: -0.01em; margin: 0.3rem 0 0.8rem; }
h2 { font-size: 1.6rem; margin: 0 0 0.4rem; }
h3 { font-size: 1.12rem; margin: 2.2rem 0 0.7rem; overflow-wrap: anywhere; }
h2 + .key, h2 + .facts { margin-top: 1.4rem; }
h2 + .charts, .key + .charts { margin-top: 1.4rem; }
header .lead { margin-bottom: 0; max-width: 90ch; }
.cards + .lead { font-size: 0.88rem; margin: 0.9rem 0 0; max-width: 90ch; }
h3 small { font: 0.88rem var(--sans); color: var(--muted); margin-left: 0.5rem; }
h4 { font: 600 0.9rem var(--sans); margin: 1.2rem 0 0.5rem; overflow-wrap: anywhere; }
h4 small { font-weight: 400; color: var(--muted); margin-left: 0.4rem; }
p { margin: 0 0 1rem; max-width: 70ch; overflow-wrap: anywhere; }
.eyebrow {
  margin: 0; color: var(--muted); font-size: 0.82rem; letter-spacing: 0.09em; text-transform:
  uppercase;
}
.lead { color: var(--muted); margin-bottom: 1.6rem; }
section { margin-top: 4.2rem; padding-top: 2.2rem; border-top: 1px solid var(--line); }
.cards {
  display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 9.4rem), 1fr)); gap:
  0.9rem;
}
.cards.many { grid-template-columns: repeat(auto-fit, minmax(min(100%, 16rem), 1fr)); }
.cards.more { grid-template-columns: repeat(auto-fit, minmax(min(100%, 14rem), 1fr)); }
.card {
  background: var(--card); border: 1px solid var(--line); border-radius: 10px; padding: 1rem 1.1rem 1.1rem;
}
.card h2 { font: 600 0.84rem var(--sans); color: var(--muted); margin: 0 0 0.5rem; }
.card p { margin: 0; font-variant-numeric: tabular-nums; }
.card .big { font-size: 1.85rem; line-height: 1.15; letter-spacing: -0.02em; }
.card .big small { font-size: 0.95rem; letter-spacing: 0; color: var(--muted); margin-left: 0.25rem; }
.card .std { color: var(--muted); font-size: 0.86rem; }
.card .row { display: flex; justify-content: space-between; gap: 1rem; padding: 0.16rem 0; }
.card .row span { overflow: hidden; text-overflow: ellipsis; white-space: nowrap; }
.scroll { overflow-x: auto; margin: 0 0 2.4rem; }
table { border-collapse: collapse; width: 100%; font-size: 0.92rem; font-variant-numeric: tabular-nums; }
caption { text-align: left; font: 600 1.12rem/1.3 var(--serif); padding: 0 0 0.6rem; }
th, td {
  padding: 0.5rem 0.9rem; text-align: right; white-space: nowrap; border-bottom: 1px solid
  var(--line);
}
th:first-child, td:first-child { text-align: left; padding-left: 0; }
th:last-child, td:last-child { padding-right: 0; }
thead th { font-weight: 600; vertical-align: bottom; border-bottom: 2px solid var(--ink); }
thead small, td small { color: var(--muted); font-weight: 400; font-size: 0.86em; }
tbody th { font-weight: 400; }
.dense th, .dense td { padding: 0.4rem 0.5rem; font-size: 0.84rem; }
.dense th:first-child { padding-left: 0; } .dense th:last-child, .dense td:last-child { padding-right: 0; }
small.fitted { color: var(--muted); font-style: italic; margin-left: 0.4rem; }
.data { margin-top: 5rem; padding-top: 1.6rem; border-top: 4px double var(--line); }
.data h1 { font-size: clamp(1.6rem, 3.5vw, 2.2rem); }
.data h1 small { font: 1rem var(--sans); color: var(--muted); margin-left: 0.5rem; letter-spacing: 0; }
.data + section, .contents + section { margin-top: 2rem; }
tr.group th { color: var(--muted); font-size: 0.86rem; padding-top: 1rem; }
.best { font-weight: 700; }
.facts td, .facts th, .facts th:last-child {
  text-align: left; white-space: normal; vertical-align: top; overflow-wrap: anywhere;
}
.facts tbody th { color: var(--muted); width: 14rem; }
.facts.pair {
  display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 28rem), 1fr)); gap: 0
  3.5rem;
}
.facts.pair tbody th { width: 45%; }
.facts.pair tr:first-child > * { border-top: 2px solid var(--ink); }
.facts .differs { font-weight: 600; }
.none { color: var(--muted); }
.dot { display: inline-block; width: 0.62rem; height: 0.62rem; border-radius: 50%; margin-right: 0.5rem; }
.dot.s0 { background: var(--s0); } .dot.s1 { background: var(--s1); } .dot.s2 { background: var(--s2); }
.dot.s3 { background: var(--s3); } .dot.s4 { background: var(--s4); } .dot.s5 { background: var(--s5); }
.key { display: flex; flex-wrap: wrap; gap: 0.4rem 1.6rem; align-items: center; color: var(--muted);
  font-size: 0.88rem; margin: 0 0 0.4rem; max-width: none; }
.key b { display: inline-block; width: 0.9rem; height: 0.9rem; border-radius: 3px; margin-right: 0.45rem;
  vertical-align: -0.1rem; border: 1px solid var(--line); }
.bar { display: inline-block; width: 11rem; height: 0.75rem; border-radius: 3px; margin: 0 0.5rem;
  vertical-align: -0.08rem; border: 1px solid var(--line); }
.strip .bar { width: 3.4rem; margin: 0 0.2rem; }
.strip { display: grid; grid-template-columns: repeat(5, 1fr); gap: 0.7rem; margin: 0 0 1.2rem; }
.strip.three { grid-template-columns: repeat(3, 1fr); }
.thirds { display: grid; grid-template-columns: repeat(3, 1fr); gap: 0.7rem; margin: 0 0 1.2rem; }
.thirds figcaption:empty { display: none; }
.strip.small img { image-rendering: pixelated; }
.sweep { display: grid; grid-template-columns: 5.6rem repeat(var(--suns), minmax(5.2rem, 1fr)); gap: 0.5rem;
  align-items: center; font-size: 0.82rem; }
.sweep .side { font-weight: 600; overflow-wrap: anywhere; }
.sweep .sun { text-align: center; line-height: 1.3; font-variant-numeric: tabular-nums; }
.sweep .sun small { color: var(--muted); }
.sweep figure { align-self: start; } .sweep figcaption { text-align: center; margin-top: 0.15rem; }
.sweep figcaption:empty, .pair figcaption { display: none; }
.hole { align-self: stretch; min-height: 5.2rem; display: grid; place-items: center; color: var(--muted);
  border: 1px dashed var(--line); border-radius: 6px; }
.pairs { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 15rem), 1fr)); gap: 1.2rem 1.4rem; }
.pair { display: grid; grid-template-columns: 1fr 1fr; gap: 0.35rem; align-content: start; break-inside: avoid; }
.pair p { grid-column: span 2; margin: 0; color: var(--muted); font-size: 0.78rem; line-height: 1.4;
  font-variant-numeric: tabular-nums; }
.pair.small img, .sweep.small img { image-rendering: pixelated; }
figure { margin: 0; break-inside: avoid; }
figure img { display: block; width: 100%; height: auto; border-radius: 6px; background: #000; }
figcaption {
  color: var(--muted); font-size: 0.82rem; margin-top: 0.35rem; font-variant-numeric: tabular-nums;
}
.charts {
  display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 21rem), 1fr)); gap: 1.6rem
  2rem;
}
.charts.three { grid-template-columns: repeat(auto-fill, minmax(min(100%, 18rem), 1fr)); margin-bottom: 2rem; }
.multiples {
  display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 12.5rem), 1fr)); gap:
  1.4rem;
}
svg { display: block; width: 100%; height: auto; overflow: visible; }
svg text { fill: var(--muted); font: 12px var(--sans); font-variant-numeric: tabular-nums; }
svg .axis { stroke: var(--line); stroke-width: 1; fill: none; }
svg .base { stroke: var(--muted); stroke-width: 1; fill: none; }
svg .line { fill: none; stroke-width: 2; stroke-linejoin: round; }
svg .block { stroke-width: 1.5; fill-opacity: 0.28; }
svg .s0 { stroke: var(--s0); fill: var(--s0); } svg .s1 { stroke: var(--s1); fill: var(--s1); }
svg .s2 { stroke: var(--s2); fill: var(--s2); } svg .s3 { stroke: var(--s3); fill: var(--s3); }
svg .s4 { stroke: var(--s4); fill: var(--s4); } svg .s5 { stroke: var(--s5); fill: var(--s5); }
svg .line.s0, svg .line.s1, svg .line.s2, svg .line.s3, svg .line.s4, svg .line.s5 { fill: none; }
svg .cell { stroke: none; }
pre { background: var(--wash); border-radius: 8px; padding: 0.9rem 1.1rem; overflow-x: auto; font-size:
  0.86rem;
  white-space: pre-wrap; overflow-wrap: anywhere; margin: 0 0 1rem; }
dl { display: grid; grid-template-columns: minmax(9rem, max-content) 1fr; gap: 0.35rem 1.6rem; margin:
  -1.2rem 0 3.2rem;
  font-size: 0.92rem; }
dt { font-weight: 600; } dd { margin: 0; color: var(--muted); }
ul {
  padding-left: 1.2rem; margin: 0; max-width: 75ch; } li { margin-bottom: 0.4rem; overflow-wrap:
  anywhere;
}
footer { margin-top: 5rem; color: var(--muted); font-size: 0.86rem; }
@media (max-width: 720px) {
  main { padding: 2.2rem 1.1rem 4rem; }
  section { margin-top: 3rem; padding-top: 1.6rem; }
  .strip { grid-template-columns: repeat(6, 1fr); }
  .strip figure { grid-column: span 2; }
  .strip figure:nth-child(-n+2) { grid-column: span 3; }
  .multiples { grid-template-columns: 1fr 1fr; gap: 1.2rem; }
  dl { grid-template-columns: 1fr; } dd { margin-bottom: 0.5rem; }
  .cards { gap: 0.7rem; }
  .cards.many { grid-template-columns: 1fr; }
  .cards.more { grid-template-columns: repeat(auto-fit, minmax(min(100%, 9.4rem), 1fr)); }
  .card { padding: 0.8rem 0.9rem 0.9rem; } .card .big { font-size: 1.7rem; }
  .facts tbody th, .facts.pair tbody th { width: 45%; }
}
@media print {
  :root { --paper: #fff; --card: #fff; --ink: #000; --muted: #444; --line: #ccc; --wash: #f4f4f4;
    --s0: #2a66ad; --s1: #b9560f; --s2: #2f7d4f; --s3: #8a4b9e; --s4: #a33a3a; --s5: #5c6b00; }
  body { font-size: 10pt; } main { max-width: none; padding: 0; }
  section { margin-top: 1.6rem; padding-top: 1rem; }
  h2, h3, h4, caption { break-after: avoid; } table, .card, .strip, svg, pre { break-inside: avoid; }
  .scroll { overflow: visible; } th, td { padding: 0.3rem 0.5rem; }
  * { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
}
"""
