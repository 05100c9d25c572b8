"""Operations on finished splats, one after the other: select, move, join, and make fewer."""
