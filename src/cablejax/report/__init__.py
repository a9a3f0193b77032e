"""What a closed-loop run looks like: figures, an animation, and one self-contained HTML page."""
