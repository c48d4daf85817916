"""How the report's page looks: colours for light and dark, type, tables, cards. The drawn panels take their colours from here."""

CSS = """
:root{--ink:#1b1f27;--muted:#68707d;--faint:#e3e6eb;--paper:#fdfdfe;--card:#f4f6f8;--first:#0072b2;--second:#d55e00;--peer:#009e73;
--good:#00734f;--goodbg:#e0f3ec;--bad:#a83c00;--badbg:#fbe9df;
--font:Inter,"Segoe UI",system-ui,-apple-system,"Helvetica Neue","Noto Sans","DejaVu Sans",sans-serif}
@media (prefers-color-scheme:dark){:root{--ink:#e9ecf1;--muted:#9aa3b0;--faint:#2c323b;--paper:#14171c;--card:#1c2027;--first:#56b4e9;
--second:#e69f00;--peer:#2fc99b;--good:#62d6b0;--goodbg:#12332a;--bad:#ffa570;--badbg:#3d2415}}
*{box-sizing:border-box}
body{margin:0;background:var(--paper);color:var(--ink);font:16px/1.55 var(--font);-webkit-text-size-adjust:100%}
main{max-width:1120px;margin:0 auto;padding:56px 28px 72px}
header{margin-bottom:56px}
.above{margin:0;color:var(--muted);font-size:13px;letter-spacing:.09em;text-transform:uppercase}
h1{margin:2px 0 14px;font-size:38px;line-height:1.15;font-weight:650;letter-spacing:-.02em}
h2{margin:0 0 6px;font-size:22px;font-weight:620;letter-spacing:-.01em}
section{margin:0 0 60px}
.lead{margin:0 0 20px;max-width:74ch;color:var(--muted);font-size:15px}
.names{list-style:none;margin:0 0 26px;padding:0;font-size:15px}
.names li{margin:4px 0}
.muted{color:var(--muted)}
.swatch{display:inline-block;width:22px;height:4px;border-radius:2px;margin:0 8px 4px 0}
.c0{background:var(--first)}.c1{background:var(--second)}
.pill{display:inline-block;margin-left:6px;padding:1px 10px;border-radius:99px;font-size:13px;white-space:nowrap}
.yes{color:var(--good);background:var(--goodbg)}.no{color:var(--bad);background:var(--badbg)}
.cards{display:grid;grid-template-columns:repeat(auto-fit,minmax(148px,1fr));gap:12px}
.card{background:var(--card);border-radius:10px;padding:14px 16px 12px;border-top:3px solid transparent}
.card.pass{border-top-color:var(--peer)}.card.fail{border-top-color:var(--bad)}
.card span,.card small{display:block;color:var(--muted);font-size:13px}
.card b{display:block;font-size:28px;line-height:1.25;font-weight:600;letter-spacing:-.02em;font-variant-numeric:tabular-nums}
.scroll{overflow-x:auto}
table{border-collapse:collapse;font-size:14.5px;font-variant-numeric:tabular-nums}
th,td{padding:6px 18px 6px 0;text-align:right;white-space:nowrap;border-bottom:1px solid var(--faint)}
th:first-child,td:first-child{text-align:left}
thead th{color:var(--muted);font-weight:500;font-size:13px}
tbody th{font-weight:450}
.exam{min-width:620px;width:100%;max-width:860px}
tr.sub th{padding-left:18px;color:var(--muted)}tr.sub td{color:var(--muted)}
td small{color:var(--muted);font-size:12px;display:inline-block;min-width:50px;text-align:right}
td .pass::after,td .fail::after{display:inline-block;width:18px;text-align:right;font-weight:600}
td .value::after{content:"";display:inline-block;width:18px}
td .pass::after{content:"\\2713";color:var(--good)}td .fail::after{content:"\\2717";color:var(--bad)}
td .fail{color:var(--bad)}
.panels{display:grid;gap:22px 20px;grid-template-columns:repeat(3,minmax(0,1fr))}
.wide{grid-template-columns:minmax(0,760px)}.half{grid-template-columns:repeat(2,minmax(0,1fr))}
figure{margin:0}
figure svg{display:block;width:100%;height:auto;overflow:visible}
.panels+.scroll,.panels+details{margin-top:22px}
details{margin-top:18px}
summary{cursor:pointer;color:var(--muted);font-size:14.5px;margin-bottom:8px}
footer{border-top:1px solid var(--faint);padding-top:22px;color:var(--muted);font-size:14px}
footer p{margin:0 0 4px}footer b{color:var(--ink);font-weight:600}
code{font-family:ui-monospace,"SF Mono",Menlo,Consolas,"DejaVu Sans Mono",monospace;font-size:.92em}
@media (max-width:900px){.panels{grid-template-columns:repeat(2,minmax(0,1fr))}.wide,.half{grid-template-columns:1fr}}
@media (max-width:600px){main{padding:32px 18px 48px}h1{font-size:30px}.panels{grid-template-columns:1fr}
.cards{grid-template-columns:repeat(2,1fr)}.pill{margin:2px 6px 2px 0}th,td{padding-right:12px}}
@media print{main{max-width:none;padding:0}section{break-inside:avoid-page}}
"""
