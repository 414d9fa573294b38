"""What is wrong with a session, before any work is spent on it; and how its repeats scatter."""
