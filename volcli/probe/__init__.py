"""One ray through a scene, walked slowly and in full view: what it crosses, and what it sees.

field.py    a grid along a ray: where its polynomials begin and end, and its values
walk.py     the integrals along the ray, in NumPy and float64, and what they look like on the way
rules.py    the same ray by volcli's compiled rules, and where they take their samples
rays.py     a job to its rays, each walked and put through the rules
report.py   all of it as plain data, and as CSV
plot.py     all of it as a figure

The walk shares no code with the kernels, so that it checks them as well: every crossing with a
plane of a lattice is listed and sorted, and between two of them a field is one polynomial.
"""
