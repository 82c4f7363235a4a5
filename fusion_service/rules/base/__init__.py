"""What every rule stands on: its declaration, the block of estimates it fuses, small matrices, the chain of pairs."""
