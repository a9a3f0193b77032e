"""Cable logs with withheld causes, from simulators that share no code with the one that diagnoses them."""
