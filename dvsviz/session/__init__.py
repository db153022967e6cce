"""What a run leaves behind: its nouns, the file schema, writer and reader."""
