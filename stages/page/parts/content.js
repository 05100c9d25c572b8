// The source of the splats: an address, or chunks of base64 in the document that together are one
// gzip of a .ply.
function bytesOf(base64) {
    const text = atob(base64);
    const bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
    return bytes;
}

async function contentOf(scene) {
    if (scene.content) return fetch(scene.content);
    const parts = [];
    for (const element of document.querySelectorAll("script.splats")) {
        parts.push(bytesOf(element.textContent));
        element.remove(); // so that the text and the bytes need not both stay in memory
    }
    const plain = new Blob(parts).stream().pipeThrough(new DecompressionStream("gzip"));
    const whole = await new Response(plain).blob();
    return new Response(whole, { headers: { "content-length": String(whole.size) } });
}
