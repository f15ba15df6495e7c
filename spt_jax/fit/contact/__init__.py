"""The stages of a fit with the self-intersection penalty: a search by cuts, on the host."""
