"""Which positions to take: their information, the best schemes with proof, what more bring.

Open `information` first.
"""
