"""What is said about a result: `result.json` and the lines on the terminal."""
