"""What is done with a recording: scored, explained, fused again, exported, drawn."""
