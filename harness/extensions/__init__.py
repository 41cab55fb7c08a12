"""Hold what goes beyond the paper's method:
each folder is one extension, and nothing else imports it.
"""
