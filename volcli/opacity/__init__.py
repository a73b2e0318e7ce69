"""What an image says of the opacity of a volume: maps, their statistics, and pictures of them.

maps.py         an image to maps: opacity, transmittance, optical depth, depth, colour
statistics.py   maps to numbers
findings.py     numbers to sentences: empty, thin, solid, clipped, banded, not premultiplied
heatmap.py      a map in colours, with a colour bar and contour lines
blocks.py       a small picture in the characters of a terminal
page.py         one HTML file to look at images with
colormap.py     colour maps by name, and where values lie in one
background.py   another background behind a picture that is already rendered
difference.py   two images, channel by channel

It renders nothing and prints nothing.
"""
