"""How Sphinx makes a site of these pages: `make docs`."""

import importlib.metadata

project = "SwarmDrive Harness"
release = importlib.metadata.version("swarmdrive-harness")
extensions = ["myst_parser"]
myst_heading_anchors = 3  # those that GitHub gives, where the pages are read as well
html_theme = "furo"
html_title = f"{project} {release}"
html_copy_source = False
html_show_copyright = False
smartquotes = False  # -- begins an option
