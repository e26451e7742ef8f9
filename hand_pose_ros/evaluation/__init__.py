"""Offline evaluation: metrics, published results, bags, plots and reports."""
