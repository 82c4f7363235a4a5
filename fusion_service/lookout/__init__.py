"""What is seen of running centres from the bus alone: `status` and `top` stand on it."""
