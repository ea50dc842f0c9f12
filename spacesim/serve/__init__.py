"""The camera that answers: pose, Sun and exposure in, pictures and their truth out (docs/how-to/closed-loop.md)."""
