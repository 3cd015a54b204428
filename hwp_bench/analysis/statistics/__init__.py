"""How sure a difference is: hierarchical bootstrap, several comparisons at once, ties."""
