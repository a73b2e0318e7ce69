"""Speed against accuracy, measured on a user's own picture.

settings.py     which rules are measured, with which steps and errors
truth.py        what every pixel should be, in float64
measure.py      pictures, rendered and timed in rounds, against the truth
advice.py       the Pareto front, the order of convergence, the cheapest setting for a purpose
report.py       all of it as plain data, as CSV and as a table
plot.py         error against time
session.py      the order of things, from a job to files
"""
