"""One evaluation: a model, a prompt and a dataset, asked once and scored under every condition and seed."""
