"""What a page carries besides its text: packed data, pictures, the charting library, and what lets it run.

Charts are drawn by Vega-Lite (BSD 3-Clause, University of Washington Interactive Data Lab), which vl-convert
brings along. It is compressed in the page as everything large is; scripts are let run by their digest alone.
"""

import base64
import gzip
import hashlib
import json
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from markupsafe import Markup

from harness.core import kept
from harness.core.files import sha256_bytes

# In the order in which they need each other.
SCRIPTS = ("dom", "tables", "charts", "ends", "scene", "answers", "decision", "list", "main")
FOLDER = Path(__file__).parent / "scripts"
# Digests of the bundles of versions of vl-convert: making one takes a second, and no other script is taken
# from a cache that anyone may have written to.
BUNDLES = {"1.9.0.post1": "373b1f84072b31010f15ceb787be6b415c53936411aae267c8c2b2b6ccde46e7"}


@cache
def vega() -> str:
    """Vega, Vega-Lite and Vega-Embed as one script that leaves `vegaEmbed` behind."""
    expected = BUNDLES.get(version("vl-convert-python"))
    name = f"vega-{expected}.js"
    bundle = kept.recall(name) if expected else None
    if bundle is None or sha256_bytes(bundle) != expected:
        import vl_convert

        bundle = vl_convert.javascript_bundle("window.vegaEmbed = vegaEmbed;").encode()
        if sha256_bytes(bundle) == expected:
            kept.keep(name, bundle)
    return f"(()=>{{{bundle.decode()}}})();"


@cache
def script() -> Markup:
    """The page's own script."""
    parts = "\n".join((FOLDER / f"{name}.js").read_text(encoding="utf-8") for name in SCRIPTS)
    return Markup(f'"use strict";\n(() => {{\n{parts}}})();\n')


def licence() -> str:
    """Which libraries the page carries; their licences are in templates/licences.txt."""
    import vl_convert

    return (
        f"Charts are drawn by Vega {vl_convert.get_vega_version()}, Vega-Lite "
        f"{vl_convert.get_vegalite_versions()[-1]} and Vega-Embed, which lie in this file as vl-convert "
        f"{version('vl-convert-python')} bundles them"
    )


def packed(value: Any) -> Markup:
    """Text, or anything else as JSON, compressed, in characters that mean nothing in HTML."""
    text = value
    if not isinstance(value, str):
        text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    return Markup(base64.b64encode(gzip.compress(text.encode(), 6, mtime=0)).decode())


def picture(svg: bytes) -> str:
    """A picture as what an `img` of a page that stands alone takes."""
    return "data:image/svg+xml;base64," + base64.b64encode(svg).decode()


def policy(*scripts: str) -> str:
    """Content security policy of a page that runs these scripts and nothing else, and requests nothing."""
    allowed = " ".join(f"'sha256-{_digest(script)}'" for script in scripts)
    return (
        f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; "
        "img-src data:; base-uri 'none'; form-action 'none'"
    )


def _digest(script: str) -> str:
    return base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
