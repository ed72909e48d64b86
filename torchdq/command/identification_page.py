"""Page about an identified robot: one HTML file with its picture in it, which opens without a network."""

import base64
import io
from collections.abc import Sequence
from html import escape

from torchdq.base.optional import imported
from torchdq.command.trials import HEADER, Trial
from torchdq.learning.bodies.payload import IdentifiedPayload
from torchdq.learning.evaluate import MEANING, Evaluation, torques_by
from torchdq.learning.identification.gains import RESTS
from torchdq.learning.identification.identified import FRICTION, GAINS, NUMBERED, PARAMETERS, STATED, Identified
from torchdq.learning.logs.motions import Motion
from torchdq.learning.plots import plot_torques

BY_FILE = " By the file: of a description with the numbers found, whose friction is viscous and Coulomb alone."
DPI, QUALITY = 120, 50  # points per inch of the picture, and quality of WebP: about 100 kB, however many rows there are
STYLE = """
:root { color-scheme: light dark; --ink: #1c2733; --paper: #ffffff; --line: #d5dbe2; --soft: #f2f5f8; }
@media (prefers-color-scheme: dark) { :root { --ink: #dfe6ee; --paper: #14191f; --line: #36414d; --soft: #1e262f; } }
body { font: 16px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper);
       max-width: 62rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.6rem; margin-bottom: 0; } h2 { font-size: 1.15rem; margin-top: 2.2rem; }
.verdict { background: var(--soft); border-left: 4px solid #0072b2; padding: .7rem 1rem; }
.wide { overflow-x: auto; } .picture { background: #ffffff; border-radius: 6px; padding: .5rem; }
.picture img { width: 100%; height: auto; display: block; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .92rem; }
th, td { text-align: left; padding: .2rem 1rem .2rem 0; border-bottom: 1px solid var(--line); vertical-align: top; }
pre { background: var(--soft); padding: .7rem 1rem; overflow-x: auto; font-size: .85rem; }
summary { cursor: pointer; }
"""


def page(
    found: Identified,
    measured: Evaluation,
    test: Sequence[Motion],
    sources: Sequence[str] = (),
    messages: Sequence[str] = (),
    payload: IdentifiedPayload | None = None,
    tried: Sequence[Trial] = (),
) -> str:
    """HTML text about an identified robot: verdict, errors, picture, parameters with errors, unidentifiable ones.

    Args:
        found: from `identify`.
        measured: its evaluation.
        test: motions of the evaluation.
        sources: lines about where the numbers come from, e.g. names of the logs.
        messages: warnings that were given on the way.
        payload: what the arm holds in other motions; None: nothing was estimated.
        tried: errors that other options leave.
    Raises:
        MissingLibraryError: matplotlib is not installed.
    """
    name = found.robot.name
    parts = [
        f"<h1>{escape(name)}, identified</h1>",
        f"<p>{'<br>'.join(map(escape, sources))}</p>" if sources else "",
        f'<p class="verdict">{escape(measured.summary)}</p>\n<p>{escape(MEANING)}</p>',
        _section("Warnings", "".join(f"<p>{escape(x)}</p>" for x in messages)) if messages else "",
        _section(
            "Torques in motions that were not learned from",
            "<p>Errors are root mean squares over the standard deviation of the measured torque."
            f"{BY_FILE if measured.file is not None else ''} The picture shows what was identified, with bands that "
            f"should hold 95 % of the measurements.</p>{_table(*measured.table())}"
            f'<div class="picture">{_picture(found.by_these_gains(), torques_by(found, test))}</div>',
        ),
        _section("What may be missing", _table(HEADER, [one.cells for one in tried])) if tried else "",
        _section("Payload", f"<pre>{escape(str(payload))}</pre>") if payload is not None else "",
        _section("Identified model", _model(found)),
        _section("Unidentifiable parameters", _unidentifiable(found)),
        _section("All numbers", f"<details><summary>Parameters</summary><pre>{escape(str(found))}</pre></details>"),
    ]
    head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{escape(name)}</title>'
    body = "\n".join(part for part in parts if part)
    head = f"<head>{head}<style>{STYLE}</style></head>"
    return f'<!doctype html>\n<html lang="en">\n{head}\n<body>\n{body}\n</body>\n</html>\n'


def _section(title: str, content: str) -> str:
    return f"<h2>{escape(title)}</h2>\n{content}"


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    head = "".join(f"<th>{escape(cell)}</th>" for cell in header)
    lines = "\n".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows)
    return f'<div class="wide"><table>\n<tr>{head}</tr>\n{lines}\n</table></div>'


def _picture(found: Identified, motions: Sequence[Motion]) -> str:
    """Element <img> of measured and predicted torques."""
    matplotlib = imported("matplotlib", "matplotlib", "the page", "'torchdq[viz]'")
    file = io.BytesIO()
    with matplotlib.rc_context({"font.size": 8}):
        plot_torques(found, motions).savefig(file, format="webp", dpi=DPI, pil_kwargs={"quality": QUALITY})
    data = base64.b64encode(file.getvalue()).decode()
    return f'<img alt="Torques measured and identified, by joint" src="data:image/webp;base64,{data}">'


def _model(found: Identified) -> str:
    """Sections of what was chosen and found: friction, gains, and combinations of inertial parameters with errors."""
    parts = [] if found.selection is None else [f"<pre>{escape(str(found.selection))}</pre>"]
    if joints := found.parameter_rows()[1]:
        parts.append(f"<p>Joints; {NUMBERED}</p>{_table(PARAMETERS, joints)}")
    if friction := found.friction_rows():
        parts.append(f"<p>F{STATED[1:]}</p>{_table(FRICTION, friction)}")
    if found.gains is not None:
        parts.append(f"<p>Gains of the drives. {RESTS}</p>{_table(GAINS, found.gain_rows())}")
    base = f"<pre>{escape(found.base_table)}</pre>"
    parts.append(f"<details><summary>{found.rank} base parameters</summary>{base}</details>")
    return "\n".join(parts)


def _unidentifiable(found: Identified) -> str:
    """List of the inertial parameters that stayed near the description, by link."""
    if not found.unidentifiable:
        return "<p>None: the samples identify every parameter.</p>"
    lines = "".join(f"<li>{escape(line)}</li>" for line in found.unidentifiable)
    return (
        "<p>The samples do not identify these inertial parameters one by one, only the base parameters above; they "
        f"stay near the description. Torques do not depend on them.</p><ul>{lines}</ul>"
    )
