"""Damaged files by the thousand, each given to a command in a process with 3 GiB and 10 s.

    python -m fuzz --cases 20000

`mutate.py` makes the files, `child.py` runs the commands, `runner.py` watches it and collects what
went wrong. A case is a number: with the same seeds on disk it is the same file on any machine.
"""
