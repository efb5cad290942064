"""A page in the browser that shows a training while it runs."""
