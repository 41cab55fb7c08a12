"""Colours that the colour-blind can tell apart, and the marks that say the same again."""

# Okabe and Ito 2008.
BLUE, SKY, GREEN, ORANGE, VERMILLION, PURPLE = (
    "#0072B2",
    "#56B4E9",
    "#009E73",
    "#E69F00",
    "#D55E00",
    "#CC79A7",
)
INK, GREY, PALE = "#222222", "#777777", "#DDDDDD"
COLOURS = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY, INK)  # of series, in their order
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
