"""Building blocks of the report page: escaping, sections, tables and the style sheet."""

from __future__ import annotations

import html
from collections.abc import Iterable

__all__ = ["bars", "definitions", "escape", "page", "section", "tile"]

_STYLE = """
:root{color-scheme:light dark;--bg:#f6f7f9;--card:#fff;--ink:#16191f;--soft:#5b6472;--line:#dfe3e9;
--grid:#edf0f4;--est:#2563eb;--truth:#8a93a3;--good:#15803d;--end:#c2410c;--warn-bg:#fff7e6;
--warn:#8a5a00;--warn-line:#f2d59a;--area:#2563eb1f}
@media (prefers-color-scheme:dark){:root{--bg:#0f1216;--card:#171b21;--ink:#e8ebf0;--soft:#9aa4b2;
--line:#2a313b;--grid:#222933;--est:#6ea0ff;--truth:#8791a1;--good:#4ade80;--end:#fb923c;
--warn-bg:#2a2110;--warn:#f3c969;--warn-line:#5a4618;--area:#6ea0ff26}}
*{box-sizing:border-box}
body{margin:0;background:var(--bg);color:var(--ink);
font:15px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,"Helvetica Neue",Arial,sans-serif}
main{max-width:1160px;margin:0 auto;padding:28px 20px 56px}
header{margin-bottom:20px}
header p{margin:0;color:var(--soft)}
.brand{font-size:13px;letter-spacing:.08em;font-weight:600}
h1{font-size:28px;line-height:1.2;margin:4px 0 6px;overflow-wrap:anywhere;letter-spacing:-.01em}
h2{font-size:18px;margin:0 0 4px;letter-spacing:-.005em}
section{background:var(--card);border:1px solid var(--line);border-radius:12px;padding:18px 20px;
margin-top:16px}
.hint{color:var(--soft);font-size:13.5px;margin:0 0 12px;max-width:110ch}
.tiles{display:grid;grid-template-columns:repeat(auto-fit,minmax(160px,1fr));gap:12px}
.tile{background:var(--card);border:1px solid var(--line);border-radius:12px;padding:12px 14px}
.tile b{display:block;font-size:26px;line-height:1.25;font-weight:650;
font-variant-numeric:tabular-nums;white-space:nowrap}
.tile b small{font-size:14px;font-weight:500;color:var(--soft);margin-left:3px}
.tile span{color:var(--soft);font-size:13px;display:block}
.pair{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,420px),1fr));gap:16px}
figure{margin:0;min-width:0}
figcaption{color:var(--soft);font-size:13px;margin-top:6px}
.plot{display:block;width:100%;height:auto;border:1px solid var(--line);border-radius:8px}
.plot text{font:13px system-ui,-apple-system,"Segoe UI",Roboto,Arial,sans-serif}
.chart{margin-top:16px}.chart>div,.scroll{overflow-x:auto}.wide{min-width:820px}
.note{fill:var(--soft)}.end-text{text-anchor:end}.mid-text{text-anchor:middle}
.grid{stroke:var(--grid);fill:none;stroke-width:1}
.bar{stroke:var(--ink);fill:none;stroke-width:1.6}
.est,.truth{fill:none;stroke-linejoin:round;stroke-linecap:round}
.est{stroke:var(--est);stroke-width:2}.truth{stroke:var(--truth);stroke-width:2.4;
stroke-dasharray:1 5}
.key{fill:var(--est)}.start{fill:var(--good);stroke:var(--card);stroke-width:1.5}
.end{fill:var(--end);stroke:var(--card);stroke-width:1.5}
.area{fill:var(--area)}.mean{stroke:var(--end);stroke-width:1.4;stroke-dasharray:6 5;fill:none}
.tick{stroke:var(--soft);fill:none}
.legend{display:flex;flex-wrap:wrap;gap:4px 18px;font-size:13px;color:var(--soft);margin:10px 0}
.legend span{display:inline-flex;align-items:center;gap:7px}
.legend svg{width:26px;height:12px;flex:none}
.ramp{width:92px;height:10px;border-radius:3px;flex:none}
.keys{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(100%,340px),1fr));gap:14px}
.keys figure>div{display:grid;grid-template-columns:1fr 1fr;gap:3px;border-radius:8px;
overflow:hidden}
.keys img,.cloud img{display:block;width:100%;height:auto}
.cloud img{border:1px solid var(--line);border-radius:8px;background:var(--bg)}
.bars{display:grid;grid-template-columns:max-content 1fr max-content;gap:7px 14px;
align-items:center;font-variant-numeric:tabular-nums}
.bars i{display:block;height:14px;border-radius:3px;background:var(--est);min-width:2px}
.bars em{font-style:normal;color:var(--soft)}
dl{display:grid;grid-template-columns:max-content 1fr;gap:3px 18px;margin:0}
dt{color:var(--soft)}dd{margin:0;overflow-wrap:anywhere;font-variant-numeric:tabular-nums}
.warn{background:var(--warn-bg);border-color:var(--warn-line)}.warn h2{color:var(--warn)}
.warn ul{margin:6px 0 0;padding-left:20px}
pre{margin:10px 0 0;padding:14px;background:var(--bg);border:1px solid var(--line);
border-radius:8px;overflow:auto;max-height:560px;
font:12.5px/1.5 ui-monospace,SFMono-Regular,Menlo,Consolas,"Liberation Mono",monospace}
summary{cursor:pointer;font-size:18px;font-weight:650}
a{color:var(--est);text-decoration:none}a:hover{text-decoration:underline}
table{border-collapse:collapse;width:100%}
td{padding:5px 14px 5px 0;border-top:1px solid var(--grid);vertical-align:top}
tr:first-child td{border-top:0}td:last-child{text-align:right;padding-right:0;white-space:nowrap;
color:var(--soft);font-variant-numeric:tabular-nums}
footer{color:var(--soft);font-size:13px;margin-top:20px}
@media (max-width:560px){main{padding:18px 12px 40px}section{padding:14px}h1{font-size:22px}
.tiles{grid-template-columns:1fr 1fr;gap:8px}.tile{padding:10px 12px}.tile b{font-size:21px}
dl{grid-template-columns:1fr}dd{margin-bottom:6px}}
@media print{body{background:#fff}section,.tile{break-inside:avoid}}
"""


def escape(text: object) -> str:
    """Text made safe for HTML content and quoted attributes."""
    return html.escape(str(text), quote=True)


def page(title: str, body: str) -> str:
    """A whole HTML document; `body` is HTML already."""
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n"
        f"<body>\n<main>\n{body}\n</main>\n</body>\n</html>\n"
    )


def section(title: str, body: str, hint: str = "", css: str = "") -> str:
    """A card with a heading; `body` is HTML already, title and hint are text."""
    about = f'<p class="hint">{escape(hint)}</p>' if hint else ""
    kind = f' class="{escape(css)}"' if css else ""
    return f"<section{kind}>\n<h2>{escape(title)}</h2>\n{about}{body}\n</section>\n"


def tile(value: str, unit: str, label: str, more: str = "") -> str:
    """A headline figure."""
    small = f"<small>{escape(unit)}</small>" if unit else ""
    extra = f"<span>{escape(more)}</span>" if more else ""
    return (
        f'<div class="tile"><b>{escape(value)}{small}</b><span>{escape(label)}</span>{extra}</div>'
    )


def definitions(rows: Iterable[tuple[str, object]]) -> str:
    """Names and values."""
    return (
        "<dl>"
        + "".join(f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>" for name, value in rows)
        + "</dl>"
    )


def bars(rows: Iterable[tuple[str, float]], unit: str, whole: float) -> str:
    """Horizontal bars of non-negative values with their share of `whole`."""
    values = list(rows)
    most = max((value for _, value in values), default=0.0) or 1.0
    whole = whole or 1.0
    cells = "".join(
        f'<span>{escape(name)}</span><i style="width:{max(0.0, 100 * value / most):.1f}%"></i>'
        f"<em>{value:.2f} {escape(unit)} · {100 * value / whole:.0f} %</em>"
        for name, value in values
    )
    return f'<div class="bars">{cells}</div>'
