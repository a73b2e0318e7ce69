"""Many jobs from one file: what they are, what is done already, and who works on them.

schema.py      all that a batch file may hold besides jobs
frames.py      numbered files: ranges, patterns, which frames there are
names.py       names of outputs from the fields of a job
orbit.py       cameras of a turntable, and one camera for a whole sequence
expand.py      a batch file to its jobs
identity.py    what a job is made of and what it made, as hashes: equal ones need no rendering
manifest.py    what is done, on disk, true at any moment
volumes.py     grids kept in memory from one job of a worker to its next
work.py        one job, or a tile of one, in the process of a worker
tiles.py       a large picture in parts, and whole again
processes.py   an engine: worker processes on this machine
farm.py        an engine: workers of dask.distributed, here or on other machines
runner.py      jobs to an engine: order, retries, whose fault it was, the manifest

An engine (`runner.Engine`) knows nothing of the manifest, and a worker nothing of either.
"""
