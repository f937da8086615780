"""How stable the zero is: Allan variance, noise laws, warm-up and drift of static records.

Open `analysis` first, then `allan` and `noise_laws` for the noise and `trends` for what is not.
"""
