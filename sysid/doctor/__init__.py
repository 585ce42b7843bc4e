"""Is a recording usable, and what is wrong with it?"""
