"""The report page's dress. A Python module, so that a change of it makes pages anew."""

CSS = """
:root {
  color-scheme: light dark;
  --page: #f4f5f7; --card: #ffffff; --ink: #16191d; --soft: #5d6673; --line: #e1e4e9;
  --accent: #0d7d74; --train: #2f6fde; --test: #e07a10; --good: #2c8a4b;
  --warn-page: #fff6e0; --warn-line: #e9b949; --warn-ink: #6b4a00; --bad: #c8362f;
  --shade: 0 1px 2px rgb(20 30 40 / 6%), 0 4px 16px rgb(20 30 40 / 5%);
}
@media (prefers-color-scheme: dark) {
  :root {
    --page: #0f1215; --card: #181c21; --ink: #e8ebef; --soft: #98a2af; --line: #2a3038;
    --accent: #3fc1b3; --train: #6ba1ff; --test: #ffa84a; --good: #5cc380;
    --warn-page: #2b2312; --warn-line: #8a6a1c; --warn-ink: #f3d58c; --bad: #ff7a70;
    --shade: none;
  }
}
* { box-sizing: border-box; }
html { scroll-behavior: smooth; -webkit-text-size-adjust: 100%; }
body {
  margin: 0; background: var(--page); color: var(--ink);
  font: 15px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", sans-serif;
}
main, .top { max-width: 1240px; margin: 0 auto; padding: 0 20px; }
.top { padding-top: 34px; }
h1 { font-size: 30px; line-height: 1.15; letter-spacing: -.02em; margin: 0;
  overflow-wrap: anywhere; }
h2 { font-size: 19px; letter-spacing: -.01em; margin: 0 0 4px; }
h3 { font-size: 15px; margin: 0; font-weight: 600; overflow-wrap: anywhere; }
p { margin: 0 0 12px; }
.lead, .hint { color: var(--soft); }
.lead { margin: 6px 0 0; }
.hint { font-size: 13.5px; max-width: 78ch; }
nav { display: flex; flex-wrap: wrap; gap: 4px 18px; margin: 16px 0 0; font-size: 14px; }
nav a { color: var(--accent); text-decoration: none; }
nav a:hover { text-decoration: underline; }
section, .warnings, .calm {
  background: var(--card); border: 1px solid var(--line); border-radius: 14px;
  padding: 22px 24px; margin: 18px 0; box-shadow: var(--shade);
}
.cards { display: flex; flex-wrap: wrap; gap: 12px; margin: 12px 0 0; }
nav + .cards { margin-top: 22px; }
.card { flex: 1 1 170px; background: var(--card); border: 1px solid var(--line);
  border-radius: 14px; padding: 14px 16px 13px; box-shadow: var(--shade); min-width: 0; }
.card .name { font-size: 12.5px; color: var(--soft); }
.card .value { font-size: 22px; font-weight: 650; letter-spacing: -.02em; line-height: 1.25;
  font-variant-numeric: tabular-nums; white-space: nowrap; }
.card .unit { font-size: 14px; font-weight: 500; color: var(--soft); letter-spacing: 0; }
.card .note { font-size: 12px; color: var(--soft); line-height: 1.4; overflow-wrap: anywhere; }
.card.first { flex-basis: 250px; }
.card.first .value { color: var(--accent); font-size: 32px; }
.warnings { background: var(--warn-page); border-color: var(--warn-line); color: var(--warn-ink); }
.warnings h2 { font-size: 16px; }
.warnings ul { margin: 6px 0 0; padding-left: 20px; overflow-wrap: anywhere; }
.calm { padding: 11px 24px; color: var(--soft); font-size: 14px; }
.calm::before { content: "\\2713"; color: var(--good); font-weight: 700; margin-right: 8px; }
.bar-top { display: flex; flex-wrap: wrap; gap: 10px 24px; align-items: center;
  justify-content: space-between; margin: 4px 0 18px; }
.scale { display: flex; align-items: center; gap: 8px; font-size: 12.5px; color: var(--soft); }
.scale i { display: block; width: 170px; height: 10px; border-radius: 5px; }
.scale b { width: 12px; height: 12px; border-radius: 3px; background: #808080; margin-left: 10px; }
.choice { display: inline-flex; border: 1px solid var(--line); border-radius: 9px;
  overflow: hidden; }
.choice label { font-size: 13.5px; padding: 5px 13px; cursor: pointer; color: var(--soft); }
.choice input { position: absolute; opacity: 0; pointer-events: none; }
.choice label:has(:checked) { background: var(--accent); color: var(--card); font-weight: 600; }
.choice label:has(:focus-visible) { outline: 2px solid var(--ink); outline-offset: -2px; }
.view { margin: 0 0 26px; }
.view:last-child { margin-bottom: 0; }
.view header { display: flex; flex-wrap: wrap; gap: 4px 12px; align-items: baseline;
  margin-bottom: 9px; }
.badge { font-size: 12px; font-weight: 650; border-radius: 99px; padding: 2px 10px;
  background: var(--line); text-transform: capitalize; }
.badge.worst { background: var(--bad); color: var(--card); }
.badge.best { background: var(--good); color: var(--card); }
.view header span:last-child { color: var(--soft); font-variant-numeric: tabular-nums; }
.triple { display: grid; gap: 10px; grid-template-columns: repeat(3, minmax(0, 1fr)); }
.triple.tall { max-width: 930px; margin: 0 auto; }
.triple figure { margin: 0; position: relative; min-width: 0; }
.triple img { display: block; width: 100%; height: auto; max-height: 84vh; object-fit: contain;
  border-radius: 9px; }
.triple figcaption { position: absolute; left: 9px; top: 9px; font-size: 12px; color: #fff;
  background: rgb(0 0 0 / 58%); border-radius: 6px; padding: 1px 8px; }
.triple input, .triple .divider { display: none; }
.sliding .triple { grid-template-columns: repeat(2, minmax(0, 1fr)); --at: 50%; }
.sliding .photograph, .sliding .render, .sliding .triple input, .sliding .divider {
  grid-area: 1 / 1; }
.sliding .render { clip-path: inset(0 0 0 var(--at)); }
.sliding .render figcaption { left: auto; right: 9px; }
.sliding .triple input { display: block; width: 100%; height: 100%; margin: 0; opacity: 0;
  cursor: ew-resize; touch-action: pan-y; z-index: 2; }
.sliding .divider { display: block; position: relative; pointer-events: none; z-index: 1; }
.sliding .divider::before { content: ""; position: absolute; inset: 0 auto 0 var(--at); width: 2px;
  margin-left: -1px; background: #fff; box-shadow: 0 0 4px rgb(0 0 0 / 60%); }
.sliding .divider::after { content: "\\2194"; position: absolute; left: var(--at); top: 50%;
  width: 34px; height: 34px; margin: -17px; border-radius: 50%; background: #fff; color: #222;
  text-align: center; font: 20px/32px sans-serif; box-shadow: 0 1px 5px rgb(0 0 0 / 50%); }
.sliding input:focus-visible + .divider::after { outline: 3px solid var(--accent); }
.unseen { display: grid; gap: 14px 28px; margin: 12px 0;
  grid-template-columns: repeat(auto-fit, minmax(min(330px, 100%), 1fr)); }
.unseen h3 { margin: 10px 0 4px; }
.unseen ol { list-style: none; margin: 0; padding: 0; }
.unseen li { margin: 0 0 16px; } .unseen li > p { margin: 0 0 5px; }
.pair { display: grid; gap: 6px; grid-template-columns: repeat(2, minmax(0, 1fr)); }
.pair img { display: block; width: 100%; height: auto; max-height: 240px; object-fit: contain;
  border-radius: 9px; }
.above { width: 100%; max-width: 480px; height: auto; }
.above text { font-size: 12px; font-weight: 700; fill: var(--ink); text-anchor: middle; }
.above .train { fill: var(--train); } .above .test { fill: var(--test); }
.above .next { fill: none; stroke: var(--bad); stroke-width: 2; }
.charts { display: grid; gap: 14px 22px;
  grid-template-columns: repeat(auto-fit, minmax(min(330px, 100%), 1fr)); }
.chart { margin: 0; min-width: 0; }
.chart figcaption { font-weight: 600; font-size: 14px; }
.chart svg { width: 100%; height: auto; display: block; overflow: visible; }
.chart text { font-size: 12px; fill: var(--soft); font-variant-numeric: tabular-nums; }
.grid { stroke: var(--line); } .axis { stroke: var(--soft); stroke-opacity: .5; }
.line { fill: none; stroke: var(--accent); stroke-width: 2; stroke-linejoin: round; }
.area { fill: var(--accent); fill-opacity: .09; }
.dot { fill: transparent; } .dot:hover { fill: var(--accent); }
.bar { fill: var(--accent); fill-opacity: .75; } .bar:hover { fill-opacity: 1; }
.median { stroke: var(--test); stroke-width: 1.5; stroke-dasharray: 4 3; }
.by-time { display: none; }
.timed .by-time { display: grid; } .timed .by-step { display: none; }
#space { position: relative; height: min(72vh, 680px); border-radius: 10px; overflow: hidden;
  background: #000; }
#space canvas { position: absolute; width: 100%; height: 100%; cursor: grab; }
#space canvas:active { cursor: grabbing; }
#space canvas:focus-visible { outline: 2px solid var(--accent); outline-offset: -2px; }
#space output { position: absolute; pointer-events: none; font-size: 12px; background: var(--ink);
  color: var(--page); border-radius: 6px; padding: 1px 8px; transform: translate(10px, -28px); }
#space output:empty { display: none; }
#space p { position: absolute; inset: auto 12px 12px; margin: 0; padding: 5px 12px;
  width: fit-content; border-radius: 9px; background: var(--card); font-size: 13.5px; }
#space-tools fieldset { border: 0; margin: 12px 0 0; padding: 0; min-width: 0; display: flex;
  flex-wrap: wrap; gap: 8px 10px; align-items: center; font-size: 13.5px; }
#space-tools > :disabled { opacity: .5; }
#space-tools select, #space-tools button { font: inherit; color: inherit; background: var(--page);
  border: 1px solid var(--line); border-radius: 9px; padding: 5px 11px; min-height: 34px; }
#space-tools select { max-width: min(52vw, 300px); margin-left: 6px; }
#space-tools button { cursor: pointer; }
#space-tools [name=previous], #space-tools [name=next] { font-size: 17px; line-height: 1; }
#space-tools label:has([type=checkbox]) { display: flex; gap: 6px; align-items: center; }
#space-tools :focus-visible { outline: 2px solid var(--accent); outline-offset: 1px; }
.keys { display: flex; flex-wrap: wrap; gap: 4px 18px; margin: 10px 0 0; font-size: 13.5px;
  color: var(--soft); }
.keys i { display: inline-block; width: 11px; height: 11px; border-radius: 3px; margin-right: 6px; }
.table { overflow: auto; max-height: 560px; }
table { border-collapse: collapse; width: 100%; font-size: 14px; }
th, td { text-align: left; padding: 7px 12px 7px 0; border-bottom: 1px solid var(--line);
  vertical-align: top; }
tr:last-child td { border-bottom: 0; }
thead th { position: sticky; top: 0; background: var(--card); font-weight: 600; color: var(--soft);
  white-space: nowrap; z-index: 1; }
th button { all: unset; cursor: pointer; font: inherit; }
th button::after { content: "\\2195"; opacity: .35; margin-left: 5px; }
th[aria-sort=ascending] button::after { content: "\\2191"; opacity: 1; }
th[aria-sort=descending] button::after { content: "\\2193"; opacity: 1; }
th button:focus-visible { outline: 2px solid var(--accent); }
td.number, th.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
td.name { overflow-wrap: anywhere; min-width: 110px; }
td meter-bar { display: inline-block; width: 74px; height: 7px; border-radius: 4px;
  background: var(--line); margin-left: 10px; overflow: hidden; vertical-align: 1px; }
td meter-bar > i { display: block; height: 100%; background: var(--accent); opacity: .8; }
.skipped td { color: var(--soft); }
.pill { font-size: 12px; border-radius: 99px; padding: 1px 9px; border: 1px solid var(--line); }
.pill.run { color: var(--good); border-color: currentColor; }
dl { display: grid; grid-template-columns: minmax(110px, max-content) 1fr; gap: 5px 22px;
  margin: 8px 0 0; font-size: 14px; }
dt { color: var(--soft); } dd { margin: 0; overflow-wrap: anywhere; }
.columns { display: grid; gap: 6px 40px; margin-top: 8px;
  grid-template-columns: repeat(auto-fit, minmax(min(390px, 100%), 1fr)); }
.columns h3 { margin-top: 10px; }
details { margin-top: 16px; } summary { cursor: pointer; color: var(--accent); font-size: 14px; }
pre { overflow: auto; max-height: 460px; font-size: 12.5px; line-height: 1.45; margin: 10px 0 0;
  background: var(--page); padding: 14px; border-radius: 10px; }
.blocks { width: min(100%, 560px); height: auto; display: block; margin: 8px 0; }
.blocks rect { fill: none; stroke: var(--accent); stroke-width: 1.6; }
.blocks .region { stroke-width: 1; stroke-dasharray: 4 3; opacity: .55; }
.blocks .camera { fill: var(--ink); opacity: .7; }
.blocks text { fill: var(--accent); font: 600 15px system-ui, sans-serif; }
.foot { color: var(--soft); font-size: 13px; padding: 4px 20px 44px; text-align: center; }
@media (max-width: 760px) {
  main, .top { padding-left: 12px; padding-right: 12px; }
  section, .warnings { padding: 16px 14px; border-radius: 12px; }
  .cards { gap: 9px; }
  .card { flex-basis: 140px; padding: 11px 13px; } .card.first { flex-basis: 140px; }
  .card .value { font-size: 19px; } .card.first .value { font-size: 26px; }
  .triple, .sliding .triple { grid-template-columns: minmax(0, 1fr); }
  .triple.tall { grid-template-columns: repeat(3, minmax(0, 1fr)); gap: 5px; }
  .sliding .triple.tall { grid-template-columns: minmax(0, 1fr); }
  .triple.tall figcaption { left: 4px; top: 4px; font-size: 10.5px; padding: 0 5px; }
  .sliding .tall .render figcaption { left: auto; right: 4px; }
  dl { grid-template-columns: 1fr; gap: 0; } dd { margin-bottom: 8px; }
  #space { height: 62vh; }
}
@media print { body { background: none; } section { break-inside: avoid; box-shadow: none; } }
"""
