// Words over the surface, each at a place of it.

export class Tags {
  constructor(root) {
    this.layer = root.appendChild(document.createElement("div"));
    this.layer.setAttribute("aria-hidden", "true");
    this.kept = [];
  }

  /** tags: {kind, text, colour, place}; at: from a place to [x, y] in CSS pixels. */
  draw(tags, at) {
    while (this.kept.length < tags.length) this.kept.push(this.layer.appendChild(document.createElement("span")));
    this.kept.forEach((span, k) => {
      const tag = tags[k];
      span.hidden = !tag;
      if (!tag) return;
      const [x, y] = at(tag.place);
      if (span.className !== `tag ${tag.kind}`) span.className = `tag ${tag.kind}`;
      if (span.textContent !== tag.text) span.textContent = tag.text;
      span.style.setProperty("--colour", tag.colour);
      span.style.transform = `translate(${x.toFixed(1)}px, ${y.toFixed(1)}px)`;
    });
  }
}
