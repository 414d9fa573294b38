"""Malformed sessions by number: bases, faults, the commands that read them, and a judge.

Cases are drawn by a seeded generator of our own and not by Hypothesis: a case is a folder of
related files, so a number reproduces it on any machine, in any order and one at a time, while
Hypothesis' strength, shrinking, would cost hundreds of runs of a command for each fault; and each
case needs a process of its own, whose memory and time are measured and bounded.

    cd tests && python -m fuzz 300              the first 300, and a summary
    cd tests && python -m fuzz 300 --telling    of these, each that tries something new
    cd tests && python -m fuzz --only 4711      one, with its output; its folder is kept
"""
