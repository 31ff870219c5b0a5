"""What tests share: one contract for each protocol, which every kind of it has to pass.

Extensions can use them, too.
"""
