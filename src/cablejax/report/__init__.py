"""Reports of closed-loop runs: figures, an animation, and one self-contained HTML page."""
