// Forms for events of any kind, made from the schemas that check them.

import { make, number, numberInput } from "./text.js";

// The schema of a value that may be left out, without the alternative null.
function whole(schema, root) {
  const found = schema.anyOf?.find((one) => one.type !== "null") ?? schema;
  const { $ref } = found;
  return { ...schema, ...($ref ? root.$defs[$ref.split("/").at(-1)] : found),
    description: schema.description ?? found.description };
}

// An input for a value: its element, and what it says; undefined: left out.
function input(id, name, schema, needed, choices, root) {
  const { type, enum: words, default: usual } = schema;
  if (type === "object" && schema.properties) {
    const { rows, read } = fields(id, schema, choices, root);
    const box = make("input", { type: "checkbox", id, checked: needed });
    const inside = make("div", { class: "inside", hidden: !needed }, ...rows);
    box.onchange = () => { inside.hidden = !box.checked; };
    return { element: make("div", {}, box, inside), read: () => (box.checked ? read() : undefined) };
  }
  if (words || type === "boolean") {
    const options = words ?? ["true", "false"];
    const list = make("select", { id }, ...options.map((word) => make("option", { value: word,
      selected: word === String(usual) }, word)));
    return { element: list, read: () => (words ? list.value : list.value === "true") };
  }
  const about = { id, placeholder: usual ?? (needed ? "" : "–") };
  const text = type === "number" ? numberInput(about)
    : make("input", { ...about, type: "text", autocomplete: "off" });
  const told = { array: (given) => given.split(",").map(number),
    object: (given) => Object.fromEntries(given.split(",").map((part) => {
      const [key, value = ""] = part.split("=");
      return [key.trim(), number(value)];
    })) }[type] ?? (type === "number" ? number : (given) => given);
  const known = choices[name] ?? [];
  if (type === "object" && known.length) text.setAttribute("placeholder", `${known[0]} = …`);
  const list = make("datalist", { id: `${id}-list` },
    ...known.map((one) => make("option", { value: type === "object" ? `${one} = ` : one })));
  if (known.length) text.setAttribute("list", list.id);
  return { element: make("span", {}, text, list),
    read: () => (text.value.trim() === "" ? undefined : told(text.value)) };
}

// The fields of a schema that the run has something for: rows, and what they say as one object.
export function fields(id, schema, choices, root = schema) {
  const inputs = new Map(), rows = [];
  // first what it is about, then what must be said
  const place = ([name]) => (choices[name] ? 0 : schema.required?.includes(name) ? 1 : 2);
  const all = Object.entries(schema.properties).sort((a, b) => place(a) - place(b));
  for (const [name, of] of all) {
    if (["type", "t", "tick"].includes(name) || choices[name]?.length === 0) continue;
    const one = whole(of, root);
    const needed = schema.required?.includes(name) ?? false;
    const made = input(`${id}-${name}`, name, one, needed, choices, root);
    inputs.set(name, made);
    rows.push(make("div", { class: "row asked" }, make("label", { for: `${id}-${name}` }, name),
      made.element, make("small", {}, one.description ?? "")));
  }
  const read = () => Object.fromEntries([...inputs].map(([name, { read: say }]) => [name, say()])
    .filter(([, said]) => said !== undefined));
  return { rows, read };
}

// Whether the run has all that an event of this kind needs.
export function fits(schema, choices) {
  return !schema.required?.some((name) => choices[name]?.length === 0);
}
