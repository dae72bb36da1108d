"""Fields of a message class: what each accepts, where its arrays lie, and the functions made of them."""
