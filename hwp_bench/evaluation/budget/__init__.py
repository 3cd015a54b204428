"""Error budgets: what each estimate, and each error of the rendering, costs a method."""
