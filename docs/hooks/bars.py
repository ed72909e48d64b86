"""Bars in the columns `ratio ...` of tables: the data stay numbers of Markdown, and the theme draws them."""

import re

TABLE = re.compile(r"<table>.*?</table>", re.DOTALL)
ROW = re.compile(r"<tr>.*?</tr>", re.DOTALL)
CELL = re.compile(r"<(t[hd])[^>]*>(.*?)</\1>", re.DOTALL)
TIMES = re.compile(r"([\d.]+) x")


def drawn(html: str) -> str:
    """Page whose cells `N x` below a heading `ratio ...` have their share of the largest of the table."""
    return TABLE.sub(lambda table: _with_bars(table[0]), html)


def _with_bars(table: str) -> str:
    heads, *rows = [[cell[2] for cell in CELL.finditer(row)] for row in ROW.findall(table)]
    ratios = [k for k, head in enumerate(heads) if head.startswith("ratio")]
    shown = {x[0]: float(x[1]) for cells in rows for k in ratios if (x := TIMES.fullmatch(cells[k]))}
    for text, number in shown.items():
        cell = f'<td class="ratio" style="--share: {number / max(shown.values()):.3f}">{text}</td>'
        table = re.sub(rf"<td[^>]*>{re.escape(text)}</td>", cell, table)
    return table
