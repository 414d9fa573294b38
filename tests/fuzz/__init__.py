"""Malformed sessions by number: bases, what is done to them, the commands that read them, a judge.

Cases are drawn by a seeded generator of our own and not by Hypothesis: a case is a folder of files
that stand in relation to one another, so a number reproduces it on any machine, in any order and
one at a time, while Hypothesis' strength, shrinking, would cost hundreds of runs of a command a
fault; and each case wants a process of its own, whose memory and time are measured and bounded.

    cd tests && python -m fuzz 300             the first 300, and a summary
    cd tests && python -m fuzz 300 --telling   of these, each that tries something new
    cd tests && python -m fuzz --only 4711     one, with what it printed; its folder is kept
"""
