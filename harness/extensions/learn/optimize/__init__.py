"""`harness prompt optimize`: search the wording of a prompt on tune layouts,
certify it on report layouts.
"""
