"""The result on paper: the summary of a fit, and the certificate as a page or as text.

Open `certificate` first, which says what a report contains.
"""
