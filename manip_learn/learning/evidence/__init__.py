"""Statistical evidence that rows are held, from recombined motions."""
