"""What a page carries besides its text:
packed data, pictures, the charting library, and what lets it run.

Charts are drawn by Vega-Lite (BSD 3-Clause, University of Washington Interactive Data Lab), which
the package django-js-lib-vega-embed carries as its authors built it. It is compressed in the page
as everything large is; scripts are let run by their digest alone. The library's own digest stands
here: what another package or release puts in its place runs in no page.
"""

import base64
import gzip
import hashlib
import re
from collections.abc import Sequence
from functools import cache
from importlib.metadata import distribution, version
from importlib.resources import files
from pathlib import Path
from typing import Any

import msgspec
from markupsafe import Markup

from harness.core.errors import UserError
from harness.core.files import sha256_bytes, text_of
from harness.report.drawing.colours import BLACK, FAINT, INK, PAGE, PALE, WHITE

# In the order in which they need each other.
SCRIPTS = (
    "dom",
    "tables",
    "charts",
    "ends",
    "scene",
    "cameras",
    "answers",
    "decision",
    "list",
    "episodes",
    "replay",
    "main",
)
OF_CHARTS = ("dom", "tables", "charts", "drawn")  # of a page that has charts alone
FOLDER = Path(__file__).parent / "scripts"
PACKAGE = "django-js-lib-vega-embed"  # of which nothing needs Django
BUNDLE = "static/js_lib_vega_embed/vega-embed-full.js"
# of release 6.29.0.3
BUNDLE_SHA256 = "b6f62605c995662b5682ff986bddf3a1e2fe7f309b8acc82db8b8a4feb4d9cef"

# What figures are drawn on and around their data with, and the colours of dark pages for it. What
# has no colour is black.
_DARK = (
    (f'path[style*="fill: {WHITE.lower()}"], rect[fill="{WHITE.lower()}"]', "fill", "paper"),
    (
        f'[style*="fill: {INK}"], [style*="fill: {BLACK}"], text:not([style*="fill:"])',
        "fill",
        "ink",
    ),
    (f'[style*="stroke: {INK}"], [style*="stroke: {BLACK}"]', "stroke", "ink"),
    (f'[style*="stroke: {PALE.lower()}"]', "stroke", "line"),
    (f'[style*="fill: {FAINT.lower()}"]', "fill", "card"),
)


@cache
def vega() -> str:
    """Return Vega, Vega-Lite and Vega-Embed as one JavaScript text that defines `vegaEmbed`.

    Raises:
        UserError: the installed bundle's SHA-256 is not `BUNDLE_SHA256`.
    """
    bundle = (files("js_lib_vega_embed") / BUNDLE).read_bytes()
    actual = sha256_bytes(bundle)
    if actual != BUNDLE_SHA256:
        raise UserError(
            f"the charting library of {PACKAGE} {version(PACKAGE)} has sha256 {actual}, not "
            f"{BUNDLE_SHA256}, and would run in every report; install the harness again, whose "
            "requirements name the release"
        )
    return bundle.decode()


@cache
def script(names: Sequence[str] = SCRIPTS) -> Markup:
    """Return a page's own JavaScript, joined from the files `names`: by default the report's."""
    parts = "\n".join(text_of(FOLDER / f"{name}.js") for name in names)
    return Markup(f'"use strict";\n(() => {{\n{parts}}})();\n')


def licence() -> str:
    """Return a sentence that names the bundled charting libraries with their versions.

    The licences themselves are in templates/licences.txt.
    """
    package = distribution(PACKAGE)
    # As it stands in the file: newer Pythons refuse to write this message's long header as text.
    carried = re.findall(
        r"^\s*- (Vega.*): ([\d.]+)$", package.read_text("METADATA") or "", re.MULTILINE
    )
    named = ", ".join(f"{name} {number}" for name, number in carried)
    return (
        f"Charts are drawn by {named}, which lie in this file as {PACKAGE} {package.version} has "
        "them"
    )


def packed(value: Any) -> Markup:
    """Return text, or any other value as JSON, compressed by gzip and encoded in base64."""
    data = value.encode() if isinstance(value, str) else _JSON.encode(value)
    return Markup(base64.b64encode(gzip.compress(data, 6, mtime=0)).decode())


def _base(value: Any) -> Any:
    """Return a float or text of another class, such as NumPy's, as a plain one."""
    if isinstance(value, float | str):
        return float(value) if isinstance(value, float) else str(value)
    raise NotImplementedError


_JSON = msgspec.json.Encoder(enc_hook=_base)


def picture(content: bytes, kind: str = "svg+xml") -> str:
    """Return an image's bytes as a data URI; `kind` is its MIME subtype, such as png."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def on_dark_too(svg: bytes) -> bytes:
    """Return a figure's SVG with a style sheet that adapts its colours to a browser's dark mode."""
    rules = ""
    for elements, property_name, colour in _DARK:
        rules += f"{elements} {{{property_name}: {PAGE[colour][1]} !important}} "
    style = f"<style>@media (prefers-color-scheme: dark) {{{rules}}}</style></defs>"
    return svg.replace(b"</defs>", style.encode(), 1)


def policy(*scripts: str) -> str:
    """Return a Content-Security-Policy that allows these inline scripts alone, and no request."""
    allowed = " ".join(f"'sha256-{digest(script)}'" for script in scripts)
    return (
        f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; "
        "img-src data:; base-uri 'none'; form-action 'none'"
    )


def digest(script: str) -> str:
    """Return a script's SHA-256 in base64, as a Content-Security-Policy names it."""
    return base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
