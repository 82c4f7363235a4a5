"""What is thrown at the product by chance, and what it has to keep: see `__main__`."""
