"""How a study is run: stages, what stands and what is left to do, side by side; it knows no astronomy."""
